from setuptools import find_packages, setup

package = "active6d_core"

setup(
    name=package,
    version="0.1.0",
    description="SE(3), cameras, view hemisphere, object models, hypotheses and metrics of active6d",
    maintainer="active6d developers",
    maintainer_email="active6d@example.org",
    license="Apache-2.0",
    packages=find_packages(),
    package_data={package: ["objects/**/*", "py.typed", "ros/loopback.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    python_requires=">=3.11",
    install_requires=[
        "numpy",
        "pillow",
        "pyyaml",
        "scipy",
        "trimesh",
    ],
)
