// What a user must know of the picture: that no training image saw it, or that the camera is inside an object.

const PAST_THE_LAST = 1e-3; // seconds

// The sentences for a state; `inside` is the box around the camera or null.
function notesOf({ second, following }, lastTraining, inside) {
  const notes = [];
  if (lastTraining !== null && second > lastTraining + PAST_THE_LAST) {
    notes.push(`Beyond the last training image (${lastTraining.toFixed(2)} s): the model saw no image of this time, ` +
      "and does not know places that only these images show.");
  }
  if (inside) {
    const advice = following ? "" : " Follow the camera of the drive (R) to leave it.";
    notes.push(`The camera is inside the box of ${inside.name}.${advice}`);
  }
  return notes;
}

function showNotes(notes) {
  const list = find("notes");
  const shown = [...list.children].map((note) => note.textContent);
  if (JSON.stringify(shown) === JSON.stringify(notes)) return; // a screen reader reads what is replaced
  list.replaceChildren(...notes.map((note) => element("p", note, { className: "box note" })));
}
