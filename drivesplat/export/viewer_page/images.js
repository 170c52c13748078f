// The recorded image of a key frame, over the rendering or beside it, while the camera follows its path.

const AT_KEY_FRAME = 0.011; // seconds: a step of the time slider

// The image to show: over the rendering that of this very time, beside it the last one before; null if there is none.
function imageAt(images, { second, playing, following, image }) {
  if (image === "none" || !following) return null;
  const passed = images.filter((one) => one.second < second + AT_KEY_FRAME);
  const last = passed[passed.length - 1] || null;
  if (image === "beside" || !last) return last;
  return !playing && second - last.second < AT_KEY_FRAME ? last : null;
}

function nearestSecond(images, second) {
  const nearer = (a, b) => (Math.abs(b.second - second) < Math.abs(a.second - second) ? b : a);
  return images.reduce(nearer).second;
}

// The place of a whole recorded frame in a canvas of any shape, as CSS.
function framePlace(frame, width, height) {
  const scale = Math.min(width / frame.width, height / frame.height);
  const [w, h] = [scale * frame.width, scale * frame.height];
  const place = { left: (width - w) / 2, top: (height - h) / 2, width: w, height: h };
  return Object.fromEntries(Object.entries(place).map(([name, pixels]) => [name, `${pixels}px`]));
}

const NO_PLACE = { left: "", top: "", width: "", height: "" };

// Returns show(state, canvas), which says whether the canvas has another size now.
function imageLayer(images, frame) {
  const [layer, image, caption] = [find("recorded"), find("image-shown"), find("image-caption")];
  return (state, canvas) => {
    const shown = imageAt(images, state);
    const [beside, was] = [Boolean(shown) && state.image === "beside", document.body.classList.contains("beside")];
    document.body.classList.toggle("beside", beside);
    layer.hidden = !shown;
    find("opacity").hidden = state.image !== "over";
    if (!shown) return beside !== was;
    if (image.src !== shown.image) image.src = shown.image;
    caption.textContent = `recorded, ${shown.second.toFixed(2)} s${shown.trained ? "" : ", not trained on"}`;
    Object.assign(layer.style, beside ? NO_PLACE : framePlace(frame, canvas.clientWidth, canvas.clientHeight));
    image.style.opacity = beside ? 1 : state.opacity;
    return beside !== was;
  };
}
