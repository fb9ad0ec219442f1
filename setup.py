"""The packages, which are found, and the example scenes; all else is in ``pyproject.toml``.

The folder ``plugins`` is installed inside of the package, and so are the scenes, as ``example_scenes``.
"""

import shutil
import sys
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent


class BuildWithScenes(build_py):
    """Copies the scenes, too: those files that ``mi-diffind examples`` writes (:mod:`mi_diffind.scenes.examples`)."""

    def run(self):
        super().run()
        if self.editable_mode:  # a checkout has them
            return
        sys.path.insert(0, str(ROOT))
        from mi_diffind.scenes import examples

        target = Path(self.build_lib) / "mi_diffind" / "example_scenes"
        shutil.rmtree(target, ignore_errors=True)  # those of an earlier build
        for name in examples.files():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(examples.source() / name, target / name)


plugins = ["mi_diffind.plugins", *(f"mi_diffind.plugins.{name}" for name in find_packages("plugins"))]
setup(
    packages=[*find_packages(include=["mi_diffind", "mi_diffind.*"]), *plugins],
    package_dir={"mi_diffind": "mi_diffind", "mi_diffind.plugins": "plugins"},
    cmdclass={"build_py": BuildWithScenes},
)
