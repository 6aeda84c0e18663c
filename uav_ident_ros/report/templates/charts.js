// Draws the charts: those in sight at once, all others one by one as soon as there is time.
(() => {
const {Document} = Bokeh.require("document");
const charts = Document.from_json(JSON.parse(document.getElementById("charts").textContent));
charts.views_manager = Bokeh.index;
const waiting = new Map(charts.roots().map(
    model => [document.querySelector(`[data-root-id="${model.id}"]`), model]));
async function draw(place) {
    const model = waiting.get(place);
    if (!waiting.delete(place)) return;
    const view = await Bokeh.index.build_view(model);
    Bokeh.index.add(view);
    view.build(place);
}
const sight = new IntersectionObserver(
    seen => seen.filter(entry => entry.isIntersecting).forEach(entry => draw(entry.target)),
    {rootMargin: "50%"});
for (const place of waiting.keys()) sight.observe(place);
async function drawNext() {
    const [place] = waiting.keys();
    if (!place) return;
    await draw(place);
    requestIdleCallback(drawNext, {timeout: 200});
}
requestIdleCallback(drawNext, {timeout: 200});
})();
