from setuptools import find_packages, setup

setup(
    name="herald",
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/herald"]),
        ("share/herald", ["package.xml"]),
        ("share/herald/launch", ["launch/herald.launch.py"]),
    ],
    install_requires=["setuptools"],
    maintainer="Stories",
    maintainer_email="stories@example.org",
    description="Greets whoever is named, and counts.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["herald = herald.node:main"]},
)
