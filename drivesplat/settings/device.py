"""Settings of the compute device."""

from typing import Any, Literal

from pydantic import Field, model_validator

from drivesplat.settings import Settings


class DeviceSettings(Settings):
    """The compute device. It is not part of the settings of a result: a run on another machine reruns nothing."""

    kind: Literal["auto", "any", "cuda", "cpu"] = "auto"
    """:printed: 'auto' takes the GPU and refuses recorded scenes without one; 'any' takes the CPU where there is no
    GPU, as synthetic worlds do; 'cuda' requires a GPU; 'cpu' always takes the CPU. `device: cpu` is short for `device:
    {kind: cpu}`."""
    min_free_gb: float = Field(8.0, ge=0, le=1000)
    """:printed: Minimum free GPU memory (GB) for a training to start."""
    max_gb: float | None = Field(None, gt=0, le=1000)
    """:printed: Maximum GPU memory of a job (GB), for GPUs that jobs share. null = no limit."""

    jobs_per_card: int = Field(1, ge=1, le=64)
    """:printed: Maximum number of jobs on one GPU. Further jobs wait. For more than 1, set Snakemake's resource as
    well: `--resources gpu=<GPUs times this>`."""

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, value: Any) -> Any:
        return {"kind": value} if isinstance(value, str) else value
