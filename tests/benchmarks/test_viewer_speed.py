"""The measurement of viewer.html's speed."""

from helpers.chromium import in_a_browser
from helpers.viewer_pages import page_of, splats

from benchmarks.viewer import Speed, by_turns, table

BUSY = """"use strict"; addEventListener("wheel", () => {
  const began = performance.now();
  while (performance.now() < began + 60);
}, true);"""


@in_a_browser
def test_work_on_the_main_thread_is_measured_page_by_page(tmp_path):
    pages, page = [tmp_path / name for name in ("idle.html", "busy.html")], page_of(splats(), None)
    for path, start in zip(pages, ('"use strict";', BUSY), strict=True):
        path.write_text(page.replace('"use strict";', start, 1), encoding="utf-8")
    speeds = by_turns(pages, rounds=2, frames=5)
    assert [len(found) for found in speeds] == [2, 2]
    idle, busy = (min(speed.main_thread_ms for speed in found) for found in speeds)
    assert 0.0 < idle < 60.0 <= busy
    # five frames of 60 ms; their times are those of refreshes of the screen, 1/60 s apart
    assert all(0.0 < speed.frames <= 5 / (5 * 0.060 - 1 / 60) for speed in speeds[1])


def test_a_table_has_medians_and_extremes(tmp_path):
    speeds = [[Speed(10.0, 2.0), Speed(30.0, 4.0), Speed(12.0, 2.5)]]
    assert table([tmp_path / "a.html"], speeds).splitlines()[-1] == (
        f"| {tmp_path / 'a.html'} | 12 (10 to 30) | 2.5 (2 to 4) |"
    )
