from setuptools import find_packages, setup

package = "active6d_sim"

setup(
    name=package,
    version="0.1.0",
    description="Heaps dropped by physics, a simulated RGB-D camera and recorded datasets as camera nodes of active6d",
    maintainer="active6d developers",
    maintainer_email="active6d@example.org",
    license="Apache-2.0",
    packages=find_packages(),
    package_data={package: ["scenes/stored/*/*.npz", "py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    python_requires=">=3.11",
    install_requires=[
        "active6d_core",
        "numpy",
        "open3d-cpu",
        "pillow",
        "pybullet",
        "scipy",
        "trimesh",
    ],
    entry_points={
        "console_scripts": [
            "camera_simulator = active6d_sim.nodes.camera_simulator:main",
            "dataset_camera = active6d_sim.nodes.dataset_camera:main",
        ]
    },
)
