// Keys that do one thing each; those that move the camera are in input.js.

// Calls actions[code]() for a key, unless a list or a button has it.
function followShortcuts(actions) {
  addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey || e.repeat || !(e.code in actions)) return;
    if (e.target.matches("select") || (e.code === "Space" && e.target.matches("button, input[type=checkbox]"))) return;
    e.preventDefault();
    actions[e.code]();
  });
}
