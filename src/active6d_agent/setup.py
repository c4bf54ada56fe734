from setuptools import find_packages, setup

package = "active6d_agent"

setup(
    name=package,
    version="0.1.0",
    description="Object attention and view planning policies of active6d",
    maintainer="active6d developers",
    maintainer_email="active6d@example.org",
    license="Apache-2.0",
    packages=find_packages(),
    package_data={package: ["policies/weights/*", "bank/shipped/*.npz", "py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    python_requires=">=3.11",
    install_requires=[
        "active6d_core",
        "active6d_perception",
        "numpy",
        "safetensors",
        "scipy",
        "torch",
    ],
    # Only the Gymnasium environment and PPO need these; a robot does not.
    extras_require={"training": ["gymnasium", "stable-baselines3"]},
    entry_points={
        "console_scripts": [
            "attention_policy = active6d_agent.nodes.attention_policy:main",
        ]
    },
)
