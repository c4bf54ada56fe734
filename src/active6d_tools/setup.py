from setuptools import find_packages, setup

package = "active6d_tools"

setup(
    name=package,
    version="0.1.0",
    description="The active6d command: episodes, reports, training, evaluation, benchmarks and studies",
    maintainer="active6d developers",
    maintainer_email="active6d@example.org",
    license="Apache-2.0",
    packages=find_packages(),
    package_data={package: ["report/*.j2", "report/*.css", "report/*.js", "py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    python_requires=">=3.11",
    install_requires=[
        "active6d_agent[training]",
        "active6d_bringup",
        "active6d_core",
        "active6d_perception",
        "active6d_sim",
        "jinja2",
        "matplotlib",
        "numpy",
        "open3d-cpu",
        "opencv-contrib-python-headless",
        "pillow",
        "pyyaml",
        "rich",
        "rosbags",
        "scipy",
        "torch",
        "typer",
    ],
    entry_points={"console_scripts": ["active6d = active6d_tools.command:main"]},
)
