"""Provenance of results: settings, code and inputs of every stage behind a result, passed from stage to stage."""

from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from os.path import commonpath
from pathlib import Path
from typing import Any

from drivesplat.errors import ResultError
from drivesplat.io.storage import Provenance, canonical_json, leaves, sha256_file, sha256_text

VERSIONS_OF = ("torch", "gsplat", "numpy", "nuscenes-devkit", "lpips", "pycolmap")


def provenance(
    stage: str, settings: dict[str, Any], code: str, upstream: Iterable[Provenance], inputs: dict[str, str]
) -> Provenance:
    """The provenance of a result of `stage`, given those of the results it was made from.

    `inputs` are digests of files that no stage made (tables, a user's points file), by name. Raises ResultError if two
    of them contain the same stage with different settings or code.
    """
    merged = combine(upstream)
    merged["stages"][stage] = {"settings": settings, "code": code}
    merged["inputs"].update(inputs)
    return with_digests(merged["stages"], merged["inputs"])


def combine(records: Iterable[Provenance]) -> Provenance:
    """Several provenances as one. Raises ResultError naming the stage and the difference if they contradict."""
    stages: dict[str, Any] = {}
    inputs: dict[str, str] = {}
    for record in records:
        contradictions = differences(stages, record["stages"], shared_only=True)
        changed = [name for name, digest in record["inputs"].items() if inputs.get(name, digest) != digest]
        if contradictions or changed:
            what = "; ".join(contradictions) or f"other inputs: {', '.join(changed)}"
            raise ResultError(
                f"results that belong together were made differently ({what}); delete the older and rerun"
            )
        stages |= record["stages"]
        inputs |= record["inputs"]
    return with_digests(stages, inputs)


def with_digests(stages: dict[str, Any], inputs: dict[str, str]) -> Provenance:
    """The record with the digests that `metrics.json` specifies."""
    return {
        "settings_sha256": sha256_text(canonical_json({name: stage["settings"] for name, stage in stages.items()})),
        "code_sha256": sha256_text(canonical_json({name: stage["code"] for name, stage in stages.items()})),
        "inputs_sha256": sha256_text(canonical_json(inputs)),
        "versions": {name: package_version(name) for name in VERSIONS_OF},
        "stages": stages,
        "inputs": inputs,
    }


def differences(expected: dict[str, Any], found: dict[str, Any], shared_only: bool = False) -> list[str]:
    """How the stages of two provenances differ, in words; stages that only one has count unless `shared_only`."""
    lines = []
    for stage in sorted(expected.keys() | found.keys()):
        if stage not in expected or stage not in found:
            if not shared_only:
                lines.append(f"{stage}: {'not in this result' if stage in expected else 'no longer in the config'}")
            continue
        a, b = (leaves(side[stage]["settings"]) for side in (expected, found))
        for key in sorted(key for key in a.keys() | b.keys() if a.get(key) != b.get(key)):
            lines.append(f"{stage}: {key} is {b.get(key)!r} in the result, {a.get(key)!r} now")
        if expected[stage]["code"] != found[stage]["code"]:
            lines.append(f"{stage}: other code")
    return lines


def digests_of(files: Iterable[str | Path]) -> str:
    """One digest for a set of files, by content and by path from the folder that holds all of them."""
    paths = [Path(file).absolute() for file in files]
    folder = commonpath([path.parent for path in paths]) if paths else ""
    return sha256_text(canonical_json({path.relative_to(folder).as_posix(): sha256_file(path) for path in paths}))


def package_version(package: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
