"""The licence: Apache-2.0, and every package that the project names is in THIRD_PARTY_NOTICES.md with its licence."""

import hashlib
import importlib.metadata
import re
import tomllib
from collections.abc import Iterator

import pytest
import yaml
from helpers import REPOSITORY
from packaging.requirements import Requirement

APACHE_2_0 = "cfc7749b96f63bd31c3c42b5c471bf756814053e847c10f3eb003417bc523d30"
"""SHA-256 of https://www.apache.org/licenses/LICENSE-2.0.txt."""
PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
NOTICES = (REPOSITORY / "THIRD_PARTY_NOTICES.md").read_text(encoding="utf-8")
LISTED = dict(re.findall(r"^\| ([\w.*-]+) \| ([^|]+?) \|", NOTICES, re.M))
PERMISSIVE = re.compile(
    r"MIT|BSD|Apache|ISC\b|PSF|Python Software Foundation|Kiwi|Public Domain|TOST|any-OSI", re.IGNORECASE
)
CONDITIONS = re.compile(r"GPL|General Public|Mozilla|MPL|Proprietary|EULA|non-commercial|CC.BY.NC", re.IGNORECASE)


def normalized(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def named_requirements() -> list[str]:
    """The packages of the requirements files, and of the extras and the build in pyproject.toml."""
    files = [REPOSITORY / name for name in ("requirements.txt", "requirements-dev.txt")]
    lines = [line for file in files for line in file.read_text(encoding="utf-8").splitlines()]
    lines += [line for extra in PYPROJECT["project"].get("optional-dependencies", {}).values() for line in extra]
    lines += PYPROJECT["build-system"]["requires"]
    return sorted({normalized(Requirement(line).name) for line in lines if line.strip() and not line.startswith("#")})


def declared(name: str) -> str:
    """What an installed package says about its licence: expression, field and classifiers, on one line."""
    metadata = importlib.metadata.metadata(name)
    classifiers = [it for it in metadata.get_all("Classifier", []) if it.startswith("License ::")]
    field = (metadata.get("License") or "").strip().partition("\n")[0]
    return " ".join([metadata.get("License-Expression") or "", field, *classifiers]).strip()


def installed_requirements(name: str, seen: set[str]) -> Iterator[str]:
    """The installed packages that a package requires here, with it."""
    if (name := normalized(name)) in seen:
        return
    seen.add(name)
    try:
        requirements = importlib.metadata.requires(name) or []
    except importlib.metadata.PackageNotFoundError:
        return
    yield name
    for requirement in map(Requirement, requirements):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield from installed_requirements(requirement.name, seen)


@pytest.fixture(scope="module")
def required() -> list[str]:
    """The named packages and those behind them."""
    seen: set[str] = set()
    return [it for name in named_requirements() for it in installed_requirements(name, seen)]


def test_project_is_licensed_under_apache_2_0():
    text = (REPOSITORY / "LICENSE").read_bytes()
    assert hashlib.sha256(text).hexdigest() == APACHE_2_0
    project = PYPROJECT["project"]
    assert project["license"] == "Apache-2.0"
    assert all((REPOSITORY / name).is_file() for name in project["license-files"])
    assert yaml.safe_load((REPOSITORY / "CITATION.cff").read_text(encoding="utf-8"))["license"] == "Apache-2.0"
    assert "The drivesplat authors" in (REPOSITORY / "NOTICE").read_text(encoding="utf-8")
    assert "](LICENSE)" in (REPOSITORY / "README.md").read_text(encoding="utf-8")


def test_listed_packages_are_named_or_installed_behind_named_ones(required):
    named = {*named_requirements(), *required}  # those of an extra may not be installed
    assert {*LISTED} - named <= {"nvidia-*", "certifi", "docutils", "pathspec", "package", "origin"}


FAMILIES = {
    "MIT": "MIT", "BSD": "BSD", "Apache": "Apache", "PSF": "Python Software Foundation|PSF",
    "GPL": "GPL|General Public", "MPL": "MPL|Mozilla", "TOST": "TOST",
}  # fmt: skip


@pytest.mark.parametrize("name", named_requirements())
def test_named_package_is_listed_with_the_licence_that_the_installed_one_declares(name):
    assert name in LISTED
    try:
        said = declared(name)
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("not installed")
    expected = {family for family, pattern in FAMILIES.items() if re.search(pattern, said, re.IGNORECASE)}
    if expected:  # some have their licence in a file alone
        assert expected & {family for family in FAMILIES if family in LISTED[name]}, said


def test_packages_with_conditions_are_listed(required):
    """Copyleft and proprietary packages behind the named ones; none is for non-commercial use alone."""
    assert len(required) > 50
    for name in required:
        said = declared(name)
        if not CONDITIONS.search(said):
            assert not said or PERMISSIVE.search(said) or "Copyright" in said or "License" in said, f"{name}: {said}"
            continue
        assert name in LISTED or (name.startswith("nvidia-") and "nvidia-*" in LISTED), f"{name}: {said}"
        if re.search("non-commercial", said, re.IGNORECASE):
            assert "apache-2.0" in said.lower() and f"**{name}**" in NOTICES, f"{name}: {said}"
