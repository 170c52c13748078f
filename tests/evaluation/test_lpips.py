"""LPIPS from a backbone file, and the download of that file, whose failure never stops a run."""

import hashlib
import socket
import warnings
from http.client import BadStatusLine, IncompleteRead
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
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
    import torchvision  # takes seconds, of every worker

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
def test_the_map_equals_that_of_the_lpips_package(distance, alexnet, height, width):
    import lpips  # takes seconds, of every worker

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reference = lpips.LPIPS(net="alex", spatial=True, pnet_rand=True, verbose=False)
    convolutions = [layer for layer in reference.net.modules() if isinstance(layer, torch.nn.Conv2d)]
    for layer, number in zip(convolutions, (0, 3, 6, 8, 10), strict=True):
        layer.weight.data = alexnet[f"features.{number}.weight"]
        layer.bias.data = alexnet[f"features.{number}.bias"]
    image, truth = images(2, height, width)
    pair = (torch.from_numpy(x).float().permute(2, 0, 1)[None] * 2 - 1 for x in (image, truth))
    with torch.no_grad():
        expected = reference.eval()(*pair)[0, 0]
    found = distance(image, truth)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert found.shape == (height, width) and (found > 0).all()


class Malicious:
    """Its pickle creates a file when it is loaded."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize(
    "kind", ["missing", "empty", "a web page", "truncated", "another network", "other shapes", "a list", "malicious"]
)
def test_an_invalid_backbone_gives_a_reason_in_one_line_and_is_not_executed(kind, tmp_path, alexnet, backbone):
    path = tmp_path / "alexnet.pth"
    content = {
        "another network": torch.nn.Linear(3, 3).state_dict(),
        "other shapes": {name: torch.zeros(1) for name in alexnet},
        "a list": [1, 2, 3],
        "malicious": {**alexnet, "extra": Malicious(tmp_path / "executed")},
    }
    if kind in content:
        torch.save(content[kind], path)
    elif kind != "missing":
        texts = {"empty": b"", "a web page": b"<html>404</html>", "truncated": backbone.read_bytes()[:100_000]}
        path.write_bytes(texts[kind])
    reason, made = load_lpips({"file": str(path), "sha256": "", "unavailable": None}, CPU)
    assert made is None and str(path) in reason and "\n" not in reason
    assert not (tmp_path / "executed").exists()


def test_a_missing_backbone_raises_an_error_with_the_rule_to_run(tmp_path):
    with pytest.raises(ResultError, match=r"alexnet\.pth.*lpips_backbone"):
        lpips_map(tmp_path / "alexnet.pth", CPU)


def test_a_valid_backbone_gives_always_the_same_map_and_none_its_reason(backbone, distance):
    reason, made = load_lpips({"file": str(backbone), "sha256": "", "unavailable": None}, CPU)
    assert reason is None
    np.testing.assert_array_equal(made(*images(3)), distance(*images(3)))
    assert load_lpips(None, CPU) == ("lpips.enabled is false", None)
    assert load_lpips({"file": "x", "sha256": None, "unavailable": "no network"}, CPU) == ("no network", None)


def closed_port() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{probe.getsockname()[1]}/alexnet.pth"


def settings_of(url: str, sha256: str = DIGEST) -> LpipsSettings:
    return LpipsSettings(url=url, sha256=sha256, timeout_s=5.0)


@pytest.mark.parametrize(("digits", "length"), [(8, None), (64, -1)])
def test_a_valid_file_is_fetched_and_kept(tmp_path, digits, length):
    path = tmp_path / "lpips" / "alexnet.pth"
    with served(Site(CONTENT, length=length)) as site:
        record = provide_backbone(settings_of(site.address, DIGEST[:digits]), path)
    assert record == {"file": str(path), "sha256": DIGEST, "unavailable": None}
    assert path.read_bytes() == CONTENT and list(path.parent.iterdir()) == [path]


def refused(url: str, path: Path) -> str:
    """The reason why no file was fetched, after checks common to all cases."""
    record = provide_backbone(settings_of(url), path)
    assert record["sha256"] is None
    assert not path.exists() and not any(path.parent.glob("*")), "nothing is kept, not even a part"
    reason = record["unavailable"]
    assert reason and "\n" not in reason and f"put the file at {path}" in reason
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
    with served(site):
        reason = refused(site.address, tmp_path / "alexnet.pth")
    assert why in reason and site.address in reason


@pytest.mark.parametrize(
    "error", [BadStatusLine("220 ESMTP"), IncompleteRead(b"half"), ConnectionResetError()], ids=repr
)
def test_what_is_no_response_gives_a_reason(tmp_path, monkeypatch, error):
    monkeypatch.setattr("urllib.request.urlopen", Mock(side_effect=error))
    assert refused("http://127.0.0.1/alexnet.pth", tmp_path / "alexnet.pth")


def test_an_unreachable_server_or_an_invalid_address_gives_a_reason(tmp_path):
    path = tmp_path / "alexnet.pth"
    assert "refused" in refused(closed_port(), path)
    for url in ("nowhere", "http://", "http://127.0.0.1:none/x", "file:///nowhere/alexnet.pth"):
        assert refused(url, path)


def test_an_invalid_existing_file_is_named_and_kept(tmp_path):
    path = tmp_path / "alexnet.pth"
    path.write_bytes(b"something else")
    reason = provide_backbone(settings_of(closed_port()), path)["unavailable"]
    assert str(path) in reason and "SHA-256" in reason and "\n" not in reason
    assert path.read_bytes() == b"something else"
