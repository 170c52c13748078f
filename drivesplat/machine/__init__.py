"""The machine: compute device, doctor, building gsplat."""
