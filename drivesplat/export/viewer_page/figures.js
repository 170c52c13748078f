// Frames a second and the number of Gaussians, on request.

const FIGURE_WINDOW_MS = 1000; // frames of so long a time count
const FIGURE_STEP_MS = 250; // the figures change so often, to be readable

// Returns show(on, now, drawn, rows): whether figures are wanted, the time of a frame in milliseconds, how many Gaussians
// it draws, and of how many.
function frameFigures() {
  let [times, written] = [[], -Infinity];
  return (on, now, drawn, rows) => {
    if (!on) [times, written] = [[], -Infinity];
    if (!on) return;
    times = [...times.filter((time, i) => time > now - FIGURE_WINDOW_MS || i === times.length - 1), now];
    if (now - written < FIGURE_STEP_MS) return;
    const [ahead, all] = [drawn, rows].map((count) => count.toLocaleString("en"));
    const gaussians = `${ahead} of ${all} Gaussians drawn`;
    const passed = now - times[0];
    const rate = passed > 0 ? (1000 * (times.length - 1)) / passed : null; // not known before the second frame
    find("figures").textContent =
      rate === null ? gaussians : `${rate.toFixed(rate < 10 ? 1 : 0)} frames a second · ${gaussians}`;
    if (rate !== null) written = now;
  };
}
