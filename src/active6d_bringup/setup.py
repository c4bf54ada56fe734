from glob import glob

from setuptools import find_packages, setup

package = "active6d_bringup"

setup(
    name=package,
    version="0.1.0",
    description="Launch files, parameters, viewer layouts, episode recorder, bag player and replay",
    maintainer="active6d developers",
    maintainer_email="active6d@example.org",
    license="Apache-2.0",
    packages=find_packages(),
    package_data={package: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        *(
            (f"share/{package}/{folder}", glob(f"{folder}/*.*"))
            for folder in ("launch", "config", "config/sros2", "rviz", "foxglove")
        ),
    ],
    python_requires=">=3.11",
    install_requires=[
        "active6d_agent",
        "active6d_core",
        "active6d_perception",
        "mcap",
        "numpy",
        "opencv-contrib-python-headless",
        "pyyaml",
        "rosbags",
        "zstandard",
    ],
    entry_points={
        "console_scripts": [
            "episode_recorder = active6d_bringup.nodes.episode_recorder:main",
            "bag_player = active6d_bringup.nodes.bag_player:main",
            "camera_adapter = active6d_bringup.nodes.camera_adapter:main",
        ]
    },
)
