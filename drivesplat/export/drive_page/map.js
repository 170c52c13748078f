// The map of a drive: a click on the path opens the block's page at the time at which the vehicle was there.

// The second of the place of a line that is nearest to a point; `places` are [x, y], one for each of `seconds`.
function nearestSecond(point, places, seconds) {
  const apart = places.map(([x, y]) => (x - point.x) ** 2 + (y - point.y) ** 2);
  const nearest = apart.indexOf(Math.min(...apart));
  return { second: seconds[nearest], apart: apart[nearest] };
}

// The address of a block's page at a second, with the recorded camera.
function pageAt(page, second) {
  return `${page}#second=${second}&following=yes`;
}

// All lines of the path in the map that belong to one block, with their seconds since its first image.
function linesOf(link) {
  return [...link.querySelectorAll("polyline")].map((line) => ({
    places: [...line.points].map(({ x, y }) => [x, y]),
    seconds: line.dataset.seconds.split(" "),
  }));
}

function followPointer(map) {
  map.querySelectorAll("a").forEach((link) => {
    const lines = linesOf(link);
    // before the click, so that it also holds for a new tab
    link.addEventListener("pointerdown", (event) => {
      const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(map.getScreenCTM().inverse());
      const found = lines.map(({ places, seconds }) => nearestSecond(point, places, seconds));
      const { second } = found.reduce((best, other) => (other.apart < best.apart ? other : best));
      link.setAttribute("href", pageAt(link.dataset.page, second));
    });
  });
}
