"""Weights of segmentation networks: fetched once by a command, found without a network, and known by their digests."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from drivesplat.errors import ConfigError, DriveSplatError
from drivesplat.io.storage import canonical_json, sha256_text
from drivesplat.provenance.file_digests import file_digests
from drivesplat.settings.segment import DEFAULT_MODEL

EXTRA = "pip install 'drivesplat[segment]'"
CONFIG, SAFETENSORS, PICKLED = "config.json", ".safetensors", "pytorch_model"
MAX_QUOTED = 200
"""Maximum number of characters of a message of others."""
OF_ADE20K = "ADE20K, whose images may be used for non-commercial research and education alone"


@dataclass(frozen=True)
class KnownWeights:
    """Weights of others: the licence that their authors state, their size, and what they were trained on."""

    licence: str
    megabytes: int
    trained_on: str


KNOWN = {
    DEFAULT_MODEL: KnownWeights("MIT", 328, OF_ADE20K),
    "openmmlab/upernet-convnext-tiny": KnownWeights("MIT", 241, OF_ADE20K),
    "openmmlab/upernet-convnext-base": KnownWeights("MIT", 489, OF_ADE20K),
}


def about(model: str) -> str:
    """What is known of a model's licence, in a sentence."""
    known = KNOWN.get(model)
    if known is None:
        return f"https://huggingface.co/{model} states the licence of these weights and what they were trained on"
    return (
        f"the weights are under the licence {known.licence} ({known.megabytes} MB); they were trained on "
        f"{known.trained_on}: whether that limits their use is for you to decide"
    )


def fetch(model: str) -> Path:
    """Downloads the files of a model from Hugging Face into its cache, once; returns their folder. Prefers weights in
    the format safetensors. Raises DriveSplatError where the model cannot be had."""
    try:
        from huggingface_hub import HfApi, snapshot_download
    except ImportError:
        raise missing_package("huggingface_hub") from None
    try:
        files = HfApi().list_repo_files(model)
        return Path(snapshot_download(model, allow_patterns=needed_files(files)))
    except DriveSplatError:
        raise
    except Exception as error:  # of the library and of those that it calls; they share no base class
        why = (str(error).strip().partition("\n")[0] or type(error).__name__)[:MAX_QUOTED]
        raise DriveSplatError(
            f"{model} cannot be fetched ({why}); check its name and the network, or copy its files from another "
            "machine and name their folder as segment.model"
        ) from error


def needed_files(files: Iterable[str]) -> list[str]:
    """Those of a model's files that opening it reads: settings, and weights in one format. Raises DriveSplatError where
    there are no weights."""
    top = [name for name in files if "/" not in name]
    safe = [name for name in top if name.endswith(SAFETENSORS)]
    weights = safe or [name for name in top if name.startswith(PICKLED) and name.endswith(".bin")]
    if not weights or CONFIG not in top:
        raise DriveSplatError(f"it has no {CONFIG} with weights that transformers opens")
    return [*weights, *(name for name in top if name.endswith(".json"))]


def local_folder(model: str) -> Path:
    """The folder of a fetched model, found without a network. Raises DriveSplatError, with the command that fetches it,
    where it is not on this machine."""
    try:
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import HFValidationError
    except ImportError:
        raise missing_package("transformers") from None
    try:
        folder = Path(snapshot_download(model, local_files_only=True))
        if not (folder / CONFIG).is_file():
            raise FileNotFoundError(CONFIG)
        return folder
    except HFValidationError:
        raise ConfigError(
            f"segment.model: {model} is neither a folder, nor an .onnx file, nor a name on Hugging Face (owner/name)"
        ) from None
    except (OSError, ValueError):
        raise DriveSplatError(
            f"segment.model: the weights of {model} are not on this machine; fetch them with "
            f"`drivesplat segment fetch {model}`"
        ) from None


def weights_files(path: Path) -> list[Path]:
    """The files that decide what a model of this machine does: an .onnx file, or those in a folder that opening it
    reads. Raises ConfigError where there are none."""
    if path.is_dir():
        try:
            return sorted(path / name for name in needed_files(file.name for file in path.iterdir()))
        except DriveSplatError as error:
            raise ConfigError(f"segment.model: {path} is no model: {error}") from None
    if path.is_file() and path.suffix == ".onnx":
        return [path]
    raise ConfigError(f"segment.model: there is no {path}; name a folder with {CONFIG} and weights, or an .onnx file")


def weights_digest(files: Iterable[Path], *settings: object) -> str:
    """A digest of the content of files, by name, and of further `settings`."""
    digests = {Path(path).name: digest for path, digest in file_digests(files).items()}
    return sha256_text(canonical_json([digests, *settings]))


def missing_package(package: str) -> DriveSplatError:
    """The error for a package of the extra that is not installed."""
    return DriveSplatError(f"maps by a network need the package {package}: {EXTRA}")
