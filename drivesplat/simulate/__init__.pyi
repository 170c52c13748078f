"""What type checkers know of the package: `__getattr__` imports these names when they are first used."""

from drivesplat.simulate.env import DriveEnv as DriveEnv
from drivesplat.simulate.env import vector_env as vector_env
from drivesplat.simulate.simulation import Simulation as Simulation

__all__ = ["DriveEnv", "Simulation", "vector_env"]
