// Sliders: the upper image starts at the slider.
for (const compare of document.querySelectorAll(".compare")) {
    const slider = compare.querySelector("input");
    const move = () => compare.style.setProperty("--at", `${slider.value}%`);
    slider.addEventListener("input", move);
    move();
}

// Sorting: a click on a column title sorts, a second one reverses. Empty cells always come last.
for (const table of document.querySelectorAll("table.sortable")) {
    const body = table.tBodies[0];
    const heads = [...table.querySelectorAll("th[data-column]")];
    for (const head of heads) {
        head.querySelector("button").addEventListener("click", () => {
            const order = head.getAttribute("aria-sort") === "ascending" ? "descending" : "ascending";
            for (const other of heads) other.removeAttribute("aria-sort");
            head.setAttribute("aria-sort", order);
            const sign = order === "ascending" ? 1 : -1;
            const column = Number(head.dataset.column);
            const rows = [...body.rows];
            rows.sort((a, b) => compared(a.cells[column].dataset.value, b.cells[column].dataset.value, sign));
            body.append(...rows);
        });
    }
}

function compared(a, b, sign) {
    if (a === "" || b === "") return (a === "") - (b === "");
    const [x, y] = [Number(a), Number(b)];
    return sign * (Number.isNaN(x) || Number.isNaN(y) ? a.localeCompare(b) : x - y);
}
