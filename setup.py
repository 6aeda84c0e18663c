# SPDX-License-Identifier: Apache-2.0
"""Installation of the ament_python package; colcon and pip both read this file."""

from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "uav_ident_ros"
SHARE = f"share/{PACKAGE}"


def tree(top: str) -> list[tuple[str, list[str]]]:
    """Return one `data_files` entry per folder below `top`, keeping its layout in share/.

    Paths stay relative: `colcon build --symlink-install` links them one by one.
    """
    folders: dict[str, list[str]] = {}
    for path in sorted(Path(top).rglob("*")):
        if path.is_file() and not any(part.startswith(".") for part in path.parts):
            folders.setdefault(f"{SHARE}/{path.parent.as_posix()}", []).append(path.as_posix())
    return list(folders.items())


setup(
    name=PACKAGE,
    version="0.1.0",
    description="Online identification of the attitude dynamics of unmanned aircraft",
    license="Apache-2.0",
    maintainer="uav_ident_ros maintainers",
    maintainer_email="uav_ident_ros@example.org",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={
        PACKAGE: [
            "py.typed",
            "import_logs/*.yaml",
            "report/templates/*",
            "simulation/airframes/*.yaml",
            "simulation/airframes/jsbsim/*/*.xml",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/launch", sorted(glob("launch/*.launch.py"))),
        *tree("config"),
        *tree("bags"),
    ],
    python_requires=">=3.11",
    # rclpy and the messages come from ROS (package.xml); naming the ros-jazzy-* wheels
    # here would break every machine that has them from apt.
    install_requires=["setuptools", "numpy"],
    extras_require={
        "blackbox": ["orangebox<0.5", "pyyaml", "rosbags"],
        "import_log": ["pyulog", "pyyaml", "rosbags"],
        "jsbsim": ["jsbsim"],
        "monitor": ["rich"],
        "replay": ["bokeh", "jinja2", "pyyaml", "matplotlib", "mcap", "pyarrow", "rosbags", "tqdm"],
        # replay on a Dask cluster
        "cluster": ["distributed"],
        # colcon decides by this extra whether `colcon test` runs pytest
        "test": [
            "pytest",
            "hypothesis",
            "scipy",
            "bokeh",
            "jinja2",
            "pyyaml",
            "matplotlib",
            "mcap",
            "pyarrow",
            "rosbags",
        ],
    },
    zip_safe=True,
    entry_points={
        "console_scripts": [
            f"controller_example = {PACKAGE}.controller_example:main",
            f"demo = {PACKAGE}.commandline:demo",
            f"fleet = {PACKAGE}.commandline:fleet",
            f"identifier = {PACKAGE}.node.__main__:main",
            f"import_log = {PACKAGE}.commandline:import_log",
            f"monitor = {PACKAGE}.commandline:monitor",
            f"rate_reference = {PACKAGE}.simulation.rate_reference:main",
            f"replay = {PACKAGE}.commandline:replay",
            f"simulate = {PACKAGE}.commandline:simulate",
            f"simulated_plant = {PACKAGE}.simulation.plant_node:main",
        ],
    },
)
