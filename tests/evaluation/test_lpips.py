"""LPIPS from a backbone file, and the download of that file, whose failure never stops a run."""

import hashlib
import socket
import warnings
from http.client import BadStatusLine, IncompleteRead
from pathlib import Path

import lpips
import numpy as np
import pytest
import torch
import torchvision
from helpers.archive_server import Site, served

from drivesplat.errors import ResultError
from drivesplat.evaluation.backbone import provide_backbone
from drivesplat.evaluation.lpips_map import load_lpips, lpips_map
from drivesplat.evaluation.metrics import LpipsMap
from drivesplat.settings.evaluate import LpipsSettings

CPU = torch.device("cpu")
CONTENT = bytes(range(256)) * 300
DIGEST = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture(scope="module")
def alexnet() -> dict[str, torch.Tensor]:
    """Random weights under torchvision's names, with a small classifier in place of the large one."""
    torch.manual_seed(0)
    with torch.device("meta"):
        shapes = torchvision.models.alexnet(weights=None).state_dict()
    weights = {name: torch.randn(value.shape) * 0.05 for name, value in shapes.items() if name.startswith("features.")}
    return {**weights, "classifier.1.weight": torch.zeros(2, 2)}


@pytest.fixture(scope="module")
def backbone(alexnet, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("lpips") / "alexnet.pth"
    torch.save(alexnet, path)
    return path


@pytest.fixture(scope="module")
def distance(backbone) -> LpipsMap:
    return lpips_map(backbone, CPU)


def images(seed: int, height: int = 70, width: int = 90) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0, 1, (height, width, 3))
    return np.clip(truth + 0.2 * rng.normal(size=truth.shape), 0, 1), truth


@pytest.mark.parametrize(("height", "width"), [(70, 90), (65, 64)])
def test_different_images_have_a_positive_distance_at_every_pixel(distance, height, width):
    found = distance(*images(1, height, width))
    assert found.shape == (height, width)
    assert (found > 0).all() and np.isfinite(found).all()


def test_the_map_equals_that_of_the_lpips_package(distance, alexnet):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reference = lpips.LPIPS(net="alex", spatial=True, pnet_rand=True, verbose=False)
    convolutions = [layer for layer in reference.net.modules() if isinstance(layer, torch.nn.Conv2d)]
    for layer, number in zip(convolutions, (0, 3, 6, 8, 10), strict=True):
        layer.weight.data = alexnet[f"features.{number}.weight"]
        layer.bias.data = alexnet[f"features.{number}.bias"]
    image, truth = images(2)
    with torch.no_grad():
        expected = reference.eval()(
            *(torch.from_numpy(x).float().permute(2, 0, 1)[None] * 2 - 1 for x in (image, truth))
        )
    np.testing.assert_allclose(distance(image, truth), expected[0, 0], rtol=1e-5, atol=1e-6)


def test_lpips_does_not_depend_on_the_random_initialisation(distance, backbone):
    image, truth = images(3)
    np.testing.assert_array_equal(lpips_map(backbone, CPU)(image, truth), distance(image, truth))


class Malicious:
    """Its pickle creates a file when it is loaded."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def broken_backbone(kind: str, path: Path, alexnet: dict[str, torch.Tensor]) -> None:
    match kind:
        case "missing":
            return
        case "empty":
            path.write_bytes(b"")
        case "a web page":
            path.write_text("<html>404</html>")
        case "truncated":
            torch.save(alexnet, path)
            path.write_bytes(path.read_bytes()[:100_000])
        case "another network":
            torch.save(torch.nn.Linear(3, 3).state_dict(), path)
        case "other shapes":
            torch.save({name: torch.zeros(1) for name in alexnet}, path)
        case "a list":
            torch.save([1, 2, 3], path)
        case "malicious":
            torch.save({**alexnet, "extra": Malicious(path.parent / "executed")}, path)


@pytest.mark.parametrize(
    "kind",
    ["missing", "empty", "a web page", "truncated", "another network", "other shapes", "a list", "malicious"],
)
def test_an_invalid_backbone_gives_a_reason_in_one_line_and_is_not_executed(kind, tmp_path, alexnet):
    path = tmp_path / "alexnet.pth"
    broken_backbone(kind, path, alexnet)
    reason, made = load_lpips({"file": str(path), "sha256": "", "unavailable": None}, CPU)
    assert made is None
    assert str(path) in reason and "\n" not in reason
    assert not (tmp_path / "executed").exists()


def test_an_invalid_backbone_raises_an_error_with_the_rule_to_run(tmp_path):
    with pytest.raises(ResultError, match=r"alexnet\.pth.*lpips_backbone"):
        lpips_map(tmp_path / "alexnet.pth", CPU)


def test_a_valid_backbone_gives_a_map_and_no_reason(backbone):
    reason, made = load_lpips({"file": str(backbone), "sha256": "", "unavailable": None}, CPU)
    assert reason is None
    assert made(*images(4)).shape == (70, 90)


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        pytest.param(None, "lpips.enabled is false", id="not wanted"),
        pytest.param({"file": "x", "sha256": None, "unavailable": "no network"}, "no network", id="not fetched"),
    ],
)
def test_without_a_backbone_only_the_reason_is_returned(record, reason):
    assert load_lpips(record, CPU) == (reason, None)


def closed_port() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{probe.getsockname()[1]}/alexnet.pth"


def settings_of(url: str, sha256: str = DIGEST, timeout_s: float = 5.0) -> LpipsSettings:
    return LpipsSettings(url=url, sha256=sha256, timeout_s=timeout_s)


@pytest.mark.parametrize("digits", [8, 64])
@pytest.mark.parametrize("length", [None, -1])
def test_a_valid_file_is_fetched_and_kept(tmp_path, digits, length):
    path = tmp_path / "lpips" / "alexnet.pth"
    with served(Site(CONTENT, length=length)) as site:
        record = provide_backbone(settings_of(site.address, DIGEST[:digits]), path)
    assert record == {"file": str(path), "sha256": DIGEST, "unavailable": None}
    assert path.read_bytes() == CONTENT
    assert list(path.parent.iterdir()) == [path]


def refused(record: dict, path: Path) -> str:
    """The reason in the record of a rejected file, after checks common to all cases."""
    assert record["sha256"] is None
    assert not path.exists() and not any(path.parent.glob("*")), "nothing is kept, not even a part"
    reason = record["unavailable"]
    assert reason and "\n" not in reason
    assert f"put the file at {path}" in reason
    return reason


@pytest.mark.parametrize(
    ("site", "why"),
    [
        pytest.param(Site(b"not what was promised"), "SHA-256", id="wrong checksum"),
        pytest.param(Site(CONTENT, cut_after=[1000]), "1,000 of 76,800 bytes", id="truncated"),
        pytest.param(Site(CONTENT, status=404), "Not Found", id="404"),
    ],
)
def test_an_invalid_response_gives_a_reason_and_leaves_no_file(tmp_path, site, why):
    path = tmp_path / "alexnet.pth"
    with served(site):
        record = provide_backbone(settings_of(site.address), path)
    reason = refused(record, path)
    assert why in reason and site.address in reason


@pytest.mark.parametrize(
    "error", [BadStatusLine("220 ESMTP"), IncompleteRead(b"half"), ConnectionResetError()], ids=repr
)
def test_what_is_no_response_gives_a_reason(tmp_path, monkeypatch, error):
    def answer(*_, **__):
        raise error

    monkeypatch.setattr("urllib.request.urlopen", answer)
    path = tmp_path / "alexnet.pth"
    assert refused(provide_backbone(settings_of("http://127.0.0.1/alexnet.pth"), path), path)


def test_an_unreachable_server_gives_a_reason(tmp_path):
    path = tmp_path / "alexnet.pth"
    assert "refused" in refused(provide_backbone(settings_of(closed_port()), path), path)


@pytest.mark.parametrize("url", ["nowhere", "http://", "http://127.0.0.1:none/x", "file:///nowhere/alexnet.pth"])
def test_an_invalid_address_gives_a_reason(tmp_path, url):
    path = tmp_path / "alexnet.pth"
    assert refused(provide_backbone(settings_of(url), path), path)


def test_an_invalid_existing_file_is_named_and_kept(tmp_path):
    path = tmp_path / "alexnet.pth"
    path.write_bytes(b"something else")
    record = provide_backbone(settings_of(closed_port()), path)
    assert str(path) in record["unavailable"] and "SHA-256" in record["unavailable"]
    assert "\n" not in record["unavailable"]
    assert path.read_bytes() == b"something else"
