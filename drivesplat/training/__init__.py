"""The stage `train`, from the outside in: `stage` (files in, files out), `loop`, `step` (sample, render, losses,
backward, update). `schedule` counts steps, and `graphs` captures them. It renders with `model`, and reads no
dataset."""
