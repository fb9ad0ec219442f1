"""The packages, which are found; all else is in ``pyproject.toml``. The folder ``plugins`` is installed inside."""

from setuptools import find_packages, setup

plugins = ["mi_diffind.plugins", *(f"mi_diffind.plugins.{name}" for name in find_packages("plugins"))]
setup(
    packages=[*find_packages(include=["mi_diffind", "mi_diffind.*"]), *plugins],
    package_dir={"mi_diffind": "mi_diffind", "mi_diffind.plugins": "plugins"},
)
