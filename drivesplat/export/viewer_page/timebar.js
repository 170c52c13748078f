// The bar of the time: play, key frames, and where images are held out of the training or come after it.

// `state` has second, playing and speed; change(part) alters it and redraws. Returns update(), which shows the state.
function timeBar(state, scene, span, change) {
  const [slider, play] = [find("time"), find("play")];
  const keyFrames = scene.key_frames;
  Object.assign(slider, { min: span[0], max: span[1], step: 0.01 });
  find("marks").append(...timeMarks(scene, span).map(({ kind, left, width }) => {
    const mark = element("span", "", { className: kind });
    Object.assign(mark.style, { left: `${100 * left}%`, width: width ? `${100 * width}%` : "" });
    return mark;
  }));
  find("legend").hidden = !find("marks").childElementCount;
  const jump = (frames) => frames.length && change({ second: frames[0], playing: false });
  slider.addEventListener("input", () => change({ second: Number(slider.value), playing: false }));
  play.addEventListener("click", () => change({ playing: !state.playing }));
  find("next").addEventListener("click", () => jump(keyFrames.filter((at) => at > state.second + 1e-3)));
  find("previous").addEventListener("click", () => jump(keyFrames.filter((at) => at < state.second - 1e-3).reverse()));
  find("speed").addEventListener("change", (e) => change({ speed: Number(e.target.value) }));
  return () => {
    slider.value = state.second;
    play.textContent = state.playing ? "Pause" : "Play";
    find("clock").textContent = `${state.second.toFixed(2)} s`;
  };
}

// What the bar marks, as shares of its length: held-out images of each group, and with a `width` the time beyond the
// last training image.
function timeMarks({ held_out: heldOut, last_training: lastTraining }, [first, last]) {
  if (last <= first) return []; // a single image
  const share = (second) => Math.min(Math.max((second - first) / (last - first), 0), 1);
  const marks = Object.entries(heldOut).flatMap(([kind, seconds]) =>
    seconds.map((second) => ({ kind, left: share(second), width: 0 })));
  const known = lastTraining === null ? 1 : share(lastTraining);
  return known < 1 ? [{ kind: "beyond", left: known, width: 1 - known }, ...marks] : marks;
}
