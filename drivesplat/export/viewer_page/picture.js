// The picture as a file, and the view as a link.

// Saves the canvases, one over the other, and the notes below as a PNG. To be called right after they were drawn: WebGL
// keeps no picture.
function savePicture(layers, notes, second) {
  const [{ width, height }] = layers;
  const picture = Object.assign(document.createElement("canvas"), { width, height });
  const context = picture.getContext("2d");
  layers.forEach((layer) => context.drawImage(layer, 0, 0));
  const line = Math.max(12, Math.round(height / 40));
  context.font = `${line}px system-ui, sans-serif`;
  notes.forEach((note, i) => {
    const bottom = height - 1.8 * line * (notes.length - 1 - i);
    context.fillStyle = "#14171b";
    context.fillRect(0, bottom - 1.8 * line, width, 1.8 * line);
    context.fillStyle = "#eef1f4";
    context.fillText(note, line, bottom - 0.6 * line, width - 2 * line);
  });
  picture.toBlob((png) => {
    const address = URL.createObjectURL(png);
    const name = `${document.title} ${second.toFixed(2)}s.png`.replace(/[^\w.]+/g, "-");
    element("a", "", { href: address, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10000);
  }, "image/png");
}

// Makes the page's address that of the state, and copies it where the browser allows it.
function copyLink(state) {
  history.replaceState(null, "", fragmentOf(state));
  const written = navigator.clipboard ? navigator.clipboard.writeText(location.href) : Promise.reject();
  written.then(
    () => tell("The link to this view is copied, and is the address of this page."),
    () => tell("The address of this page is now the link to this view."));
}
