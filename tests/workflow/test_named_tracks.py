"""Which tracks a run uses of those that settings name."""

import pytest

from drivesplat.settings.config import load
from drivesplat.workflow import named_tracks
from drivesplat.workflow.named_tracks import run_targets, track_references

EDITS = """\
edits:
  gone:
    - remove: {track: aa}
  more:
    - duplicate: {track: bb, as: twin}
    - swap: {track: twin, with: cc}
"""


@pytest.fixture
def config(tmp_path):
    (tmp_path / "edits.yaml").write_text(EDITS)
    dataset = {"dataroot": "data", "scenes": ["0001", "0002"], "edits": {"0001": str(tmp_path / "edits.yaml")}}
    return load({"datasets": {"mine": dataset}, "subjects": {"0001": {"track": "dd"}}})


@pytest.mark.parametrize(
    ("targets", "edits", "subject"),
    [
        ([], ["gone", "more"], True),
        (["all"], ["gone", "more"], True),
        (["edits"], ["gone", "more"], False),
        (["looks"], [], True),
        (["results/0001/metrics.json"], [], False),
        (["results/0001/street/edits/more.mp4"], ["more"], False),
        (["results/0001/street/quad/gone.mp4", "metrics"], ["gone"], False),
        (["drives"], ["gone", "more"], False),
        (["results/0001/street/edits/gone/drive/drive.json"], ["gone"], False),
        (["results/0001/street/trajectories/gone/drive/drive.json"], [], False),
        (["results/0001/street/edits/gone/scans/scans.json"], ["gone"], False),
        (["results/0001/vanilla/removal.png"], [], True),
        (["results/0002/vanilla/removal.png"], [], False),
        (None, [], False),
    ],
)
def test_a_run_uses_the_tracks_of_its_targets(config, targets, edits, subject):
    references = track_references(config, "0001", targets)
    assert list(dict.fromkeys(one.edit for one in references.edits)) == edits
    assert references.subject == ("dd" if subject else None)
    assert track_references(config, "0002", targets).edits == ()


def test_jobs_know_the_targets_of_the_main_process(monkeypatch):
    monkeypatch.setenv(named_tracks.TARGETS, "unset")
    monkeypatch.delenv(named_tracks.TARGETS)
    assert run_targets(["results/0001/scene.json"], is_main=False) is None
    assert run_targets(["all"], is_main=True) == ["all"]
    assert run_targets(["results/0001/scene.json"], is_main=False) == ["all"]
