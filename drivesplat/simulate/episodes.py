"""Episodes: a policy drives from the beginning of a run to its end. A policy that fails ends its episode alone."""

import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesplat.errors import RequestError
from drivesplat.simulate.driven_run import DrivenRun
from drivesplat.simulate.policies import Policy
from drivesplat.simulate.simulation import Simulation


@dataclass(frozen=True)
class Episode:
    """A run to its end: its `seed`, its record, why it ended, and what the policy did wrong (None: nothing)."""

    seed: int
    run: DrivenRun
    ended: str
    failed: str | None


def driven_episode(
    simulation: Simulation,
    policy: Policy,
    seed: int,
    timeout_s: float,
    each: Callable[[Simulation], None] = lambda _: None,
) -> Episode:
    """Drives an episode. `each` is called after the beginning and after each step.

    A policy that raises, gives no valid action, or takes longer than `timeout_s` for one ends the episode; `failed`
    says so in one sentence.
    """
    simulation.reset(seed)
    failed, ended = None, "the end of its time"
    asked = _Asked(policy, timeout_s)
    try:
        asked.reset(seed)
        each(simulation)
        while not simulation.ended:
            action = asked.act(simulation.observation(), simulation.facts())
            try:
                simulation.step(action)
            except RequestError as error:
                raise _PolicyError(str(error)) from None
            each(simulation)
            if simulation.outcome is not None:
                ended = simulation.outcome
                break
    except _PolicyError as error:
        failed = f"at {simulation.time:.2f} s: {error}"
        ended = "a failed policy"
    finally:
        asked.close()
    return Episode(seed, simulation.driven(), ended, failed)


class _PolicyError(Exception):
    """What a policy did wrong."""


class _Asked:
    """A policy in a thread of its own, which can be given up."""

    def __init__(self, policy: Policy, timeout_s: float):
        self._policy, self._timeout_s = policy, timeout_s
        self._questions: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[tuple[Any, str | None]] = queue.SimpleQueue()
        threading.Thread(target=self._answer, daemon=True).start()  # a policy that hangs must not hold up the end

    def reset(self, seed: int) -> None:
        """Tells the policy that a run begins."""
        begin = getattr(self._policy, "reset", None)
        if begin is not None:
            self._ask("reset", lambda: begin(seed))

    def act(self, observation: Mapping[str, Any], facts: Mapping[str, Any]) -> np.ndarray:
        """Its action. Raises _PolicyError."""
        action = self._ask("act", lambda: self._policy.act(observation, facts))
        try:
            return np.array(action, dtype=np.float64)
        except Exception:  # of foreign types
            raise _PolicyError(f"the policy's action is {type(action).__name__}, no array of numbers") from None

    def close(self) -> None:
        """Lets the thread end."""
        self._questions.put(None)

    def _ask(self, what: str, question: Callable[[], Any]) -> Any:
        self._questions.put(question)
        try:
            answer, error = self._answers.get(timeout=self._timeout_s)
        except queue.Empty:
            raise _PolicyError(f"the policy's `{what}` took longer than {self._timeout_s:g} s") from None
        if error is not None:
            raise _PolicyError(f"the policy's `{what}` raised {error}")
        return answer

    def _answer(self) -> None:
        while (question := self._questions.get()) is not None:
            try:
                self._answers.put((question(), None))
            except BaseException as error:  # of foreign code
                lines = str(error).strip().splitlines()
                self._answers.put((None, f"{type(error).__name__}: {lines[0] if lines else 'without a message'}"))
