"""Where the packages are; everything else about the project is in pyproject.toml.

`assets/` stands at the top of the checkout and is `sart_toolkit/assets/` in a wheel, which
pyproject.toml alone can't say without a list of all packages.
"""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["sart_toolkit*"]), "sart_toolkit.assets"],
    package_dir={"sart_toolkit.assets": "assets"},
    package_data={
        "sart_toolkit": [
            "*.pyi",
            "py.typed",
            "benchmark/plans/*.toml",
            "bringup/templates/*",
            "report/templates/*",
        ],
        "sart_toolkit.assets": ["**/*"],
    },
)
