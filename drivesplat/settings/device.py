"""Where the work runs."""

from typing import Any, Literal

from pydantic import Field, model_validator

from drivesplat.settings import Settings


class DeviceSettings(Settings):
    """Where the work runs. Not part of any result's settings: moving to another machine reruns nothing."""

    kind: Literal["auto", "any", "cuda", "cpu"] = "auto"
    """'auto' takes the GPU and refuses real scenes without one; 'any' makes do with the CPU, as synthetic worlds do;
    'cuda' insists on the GPU; 'cpu' is for the patient. `device: cpu` is short for `device: {kind: cpu}`."""
    min_free_gb: float = Field(8.0, ge=0, le=1000)
    """A training does not start with less free GPU memory than this (GB)."""
    max_gb: float | None = Field(None, gt=0, le=1000)
    """A job takes no more GPU memory than this (GB), where others share the card. null = all there is."""

    jobs_per_card: int = Field(1, ge=1, le=64)
    """How many jobs may share a GPU; further ones wait. Where it is more than 1, let Snakemake start as many, too:
    `--resources gpu=<cards times this>`."""

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, value: Any) -> Any:
        return {"kind": value} if isinstance(value, str) else value
