"""What pyproject.toml cannot say: the scripts that make reference data stay out of the wheel."""

from setuptools import setup
from setuptools.command.build_py import build_py


class Installed(build_py):
    """The modules that an installation needs."""

    def find_package_modules(self, package, package_dir):
        found = super().find_package_modules(package, package_dir)
        return [one for one in found if (package, one[1][:5]) != ("tsdf.reference_data", "make_")]


setup(cmdclass={"build_py": Installed})
