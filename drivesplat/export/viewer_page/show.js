// Draws the state whenever the view, the time or the window has changed.

// The drive that the state names: its instances, where their rows are, and the rows of its camera's path.
function driveOf(scene, edit) {
  const instances = instancesOf(scene.groups, edit).map((one) => ({ ...one, label: labelOf(one) }));
  return { edit, instances, ranges: rowRanges(scene.groups, instances), camera: cameraRows(scene, edit) };
}

// The ranges of a drive's instances with their poses at the state's second, null for those not shown, and the weights
// of their `count` modes; and these poses without scale.
function posed({ instances, ranges }, arrays, count, { second, hidden }) {
  const poses = instances.map((one) => (hidden.has(one.id) ? null : instancePose(one, arrays, second)));
  const shown = instances.map((one, i) => ({
    pose: scaledPose(poses[i], one.scale), colors: one.colors, label: one.label, modes: one.modes,
    weights: poses[i] && instanceWeights(one, arrays, count, second),
  }));
  return [ranges.map((range, i) => ({ ...range, ...shown[i] })), poses];
}

// Returns { redraw, drawNow, pickAt }. redraw() draws with the browser's next frame, and goes on while the drive plays
// or figures are shown; drawNow() at once, in exact order, and returns the notes on the picture. pickAt(x, y) gives the
// instance `found` there, or null, and the `ids` of all. `controls` has fillList(instances), for another drive, and
// `updates`, called after every picture.
function shower({ scene, arrays, layers: [canvas, over], paint, span }, state, controls) {
  const [drawLines, showImage] = [linePainter(over, scene.frame), imageLayer(scene.images, scene.frame)];
  const showFigures = frameFigures();
  let [drive, waiting, before] = [null, false, null];
  const redraw = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame((now) => {
      waiting = false;
      advance(now);
      show(now);
      if (state.playing || state.figures) redraw();
    });
  };
  const shapes = { centers: arrays.means.slice(), modes: arrays.modes, largest: scene.modes_range };
  const sorter = sorterOf(shapes, NEAR, (rows) => { paint.setOrder(rows); redraw(); });
  const show = (now, exact = false) => {
    const another = !drive || drive.edit !== state.edit;
    if (another) {
      drive = driveOf(scene, state.edit);
      controls.fillList(drive.instances);
      showPicked(null);
    }
    if (state.following) state.view = cameraView(arrays, drive.camera, state.second);
    if (showImage(state, canvas)) fit();
    const [ranges, poses] = posed(drive, arrays, scene.modes, state);
    const seen = [rotationOf(state.view).map((row) => row[2]), state.view.position, ranges];
    if (another) paint.setDrive(ranges);
    if (another || exact) paint.setOrder(sorter.now(...seen));
    else sorter.later(...seen);
    const drawn = paint.draw(state.view, ranges, state);
    const boxes = boxesAt(scene, arrays, drive.instances, poses, state.second);
    const visible = state.boxes ? boxes : [];
    drawLines(state.view, linesAt(scene, arrays, visible, drive.camera, state), boxNames(visible));
    const notes = notesOf(state, scene.last_training, boxAround(boxes, state.view.position));
    showNotes(notes);
    showFigures(state.figures, now, drawn, ranges.reduce((sum, { begin, end }) => sum + end - begin, 0));
    controls.updates.forEach((update) => update());
    document.documentElement.dataset.shown = sorter.settled() ? "yes" : "sorting";
    return notes;
  };
  const advance = (now) => {
    if (state.playing && before !== null) {
      const next = state.second + ((now - before) / 1000) * state.speed;
      state.second = next > span[1] ? span[0] : next;
    }
    before = state.playing ? now : null;
  };
  const pickAt = (x, y) => {
    const ray = rayAt(state.view, pinhole(scene.frame, canvas.clientWidth, canvas.clientHeight), x, y);
    const poses = posed(drive, arrays, scene.modes, state)[1];
    const found = pickedInstance(drive.instances, poses, state.view.position, ray);
    return { found, ids: drive.instances.map(({ id }) => id) };
  };
  const fit = () => {
    const sharpness = Math.min(devicePixelRatio, 2);
    for (const layer of [canvas, over]) {
      layer.width = Math.max(1, Math.round(layer.clientWidth * sharpness));
      layer.height = Math.max(1, Math.round(layer.clientHeight * sharpness));
    }
  };
  canvas.addEventListener("webglcontextlost", () => tell("The browser lost access to the GPU: reload the page."));
  addEventListener("resize", () => { fit(); redraw(); });
  fit();
  return { redraw, drawNow: () => show(performance.now(), true), pickAt };
}
