from setuptools import find_packages, setup

package = "active6d_perception"

setup(
    name=package,
    version="0.1.0",
    description="Pose estimators, verification and hypothesis fusion of active6d",
    maintainer="active6d developers",
    maintainer_email="active6d@example.org",
    license="Apache-2.0",
    packages=find_packages(),
    package_data={
        package: [
            "estimators/dense/weights/*",
            "estimators/pose_selection.json",
            "estimators/geometric/score.json",
            "scene/weights/*",
            "py.typed",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    python_requires=">=3.11",
    install_requires=[
        "active6d_core",
        "matplotlib",
        "numba",
        "numpy",
        "open3d-cpu",
        "safetensors",
        "scipy",
        "torch",
        "trimesh",
    ],
    entry_points={
        "console_scripts": [
            "pose_estimator = active6d_perception.nodes.pose_estimator:main",
            "hypothesis_fusion = active6d_perception.nodes.hypothesis_fusion:main",
        ]
    },
)
