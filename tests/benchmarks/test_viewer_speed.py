"""The measurement of viewer.html's speed."""

from helpers.chromium import in_a_browser
from helpers.viewer_pages import page_of, splats

from benchmarks.viewer import Speed, by_turns, table


@in_a_browser
def test_pages_are_measured_by_turns(tmp_path):
    pages = [tmp_path / name for name in ("few.html", "many.html")]
    for page, count in zip(pages, (20, 20_000), strict=True):
        page.write_text(page_of(splats(count, sh_degree=1), None), encoding="utf-8")
    speeds = by_turns(pages, rounds=2, frames=5)
    assert [len(found) for found in speeds] == [2, 2]
    few, many = (min(speed.main_thread_ms for speed in found) for found in speeds)
    assert 0.0 < few < many and all(speed.frames > 0.0 for found in speeds for speed in found)


def test_a_table_has_medians_and_extremes(tmp_path):
    speeds = [[Speed(10.0, 2.0), Speed(30.0, 4.0), Speed(12.0, 2.5)]]
    assert table([tmp_path / "a.html"], speeds).splitlines()[-1] == (
        f"| {tmp_path / 'a.html'} | 12 (10 to 30) | 2.5 (2 to 4) |"
    )
