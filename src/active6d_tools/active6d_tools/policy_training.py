"""Training of learned policies: parameters from a command line, and curves that are drawn during training."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from active6d_agent.bank.scene_lookup import SceneLookup

#: Weights of the checkpoint with the best validation result, in the folder of a training.
BEST = "best.safetensors"
#: What a user calls the types of parameters.
_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


@dataclass(frozen=True)
class PolicyTraining:
    """A training that is ready to start.

    Attributes:
        folder: of its checkpoints and curve.
        total: number of rounds or environment steps.
        start: look-ups of the train and validation banks to the progress of the training.
    """

    folder: Path
    total: int
    start: Callable[[SceneLookup, SceneLookup], Iterator[Any]]

    @property
    def best(self) -> Path:
        """The weights with the best validation result."""
        return self.folder / BEST

    def is_complete(self) -> bool:
        """Whether it has been trained to its end."""
        if not (self.folder / "curve.jsonl").is_file():
            return False
        last = self.curve()[-1:]
        return any(row.get("round", row.get("steps", 0)) >= self.total for row in last)

    def curve(self) -> list[dict[str, Any]]:
        """The validation results so far."""
        return [json.loads(line) for line in (self.folder / "curve.jsonl").read_text().splitlines()]


def plan_training(
    policy: str,
    folder: Path,
    *,
    steps: int,
    seed: int = 0,
    length: int | None = None,
    groups: dict[str, dict[str, Any]] | None = None,
    resume: bool = False,
    again: bool = False,
) -> PolicyTraining:
    """A training of "view-attention" (DAgger), or of "attention" or "attention-paper" (PPO); nothing starts yet.

    Args:
        policy: to train.
        folder: of the training.
        steps: horizon T.
        seed: of the training.
        length: number of rounds of DAgger or of environment steps of PPO; None for the default.
        groups: parameters by group: training, weighing (view-attention) and reward (attention).
        resume: continue the training in that folder.
        again: replace the training in that folder.

    Raises:
        ValueError: an unknown group or parameter, a value out of range, or a folder with a training that is neither to
            go on nor to be replaced.
    """
    from active6d_agent.policies.training_folder import refuse_begun

    refuse_begun(folder, resume=resume, again=again)  # before the banks are read
    how = {"resume": resume, "again": again}
    common: dict[str, Any] = {"steps": steps, "seed": seed}
    if policy == "view-attention":
        return _plan_dagger(folder, common, length, groups or {}, how)
    if policy == "attention-paper":
        from active6d_agent.policies.attention.ppo import AS_IN_THE_PAPER

        common |= AS_IN_THE_PAPER
    return _plan_ppo(folder, common, length, groups or {}, how)


def _plan_dagger(
    folder: Path, common: dict[str, Any], length: int | None, groups: dict[str, Any], how: dict[str, bool]
) -> PolicyTraining:
    from active6d_agent.policies.view_attention.dagger import DaggerParameters, train_dagger
    from active6d_agent.policies.view_attention.network import Weighing

    own = {"rounds": length} if length else {}
    parameters = _make(DaggerParameters, "training", {**common, **own}, groups)
    weighing = _make(Weighing, "weighing", {}, groups)
    _refuse_others(groups, ("training", "weighing"))
    return PolicyTraining(
        folder,
        parameters.rounds,
        lambda train, val: train_dagger(train, val, folder, parameters, weighing, **how),
    )


def _plan_ppo(
    folder: Path, common: dict[str, Any], length: int | None, groups: dict[str, Any], how: dict[str, bool]
) -> PolicyTraining:
    from active6d_agent.environment.episodes import RewardParameters
    from active6d_agent.policies.attention.ppo import PpoParameters, train_ppo

    own = {"total": length} if length else {}
    training = groups.get("training", {})
    # The rollout must be a multiple of the horizon.
    if "rollout" not in training:
        own["rollout"] = 4 * training.get("steps", common["steps"])
    parameters = _make(PpoParameters, "training", {**common, **own}, groups)
    reward = _make(RewardParameters, "reward", {}, groups)
    _refuse_others(groups, ("training", "reward"))
    return PolicyTraining(
        folder,
        parameters.total,
        lambda train, val: train_ppo(train, val, folder, parameters, reward, **how),
    )


def _make(kind: type, group: str, own: dict[str, Any], groups: dict[str, dict[str, Any]]) -> Any:
    """A dataclass of parameters from defaults of the command and what ``--set`` gives for its group.

    Raises:
        ValueError: an unknown parameter, or a value out of range or of another type.
    """
    given = groups.get(group, {})
    known = [item.name for item in fields(kind)]
    unknown = sorted(given.keys() - set(known))
    if unknown:
        raise ValueError(f"--set {group}.{unknown[0]}: known are {', '.join(known)}")
    for item in fields(kind):
        value, wanted = given.get(item.name, item.default), type(item.default)
        if not isinstance(value, (int, float) if wanted is float else wanted) or isinstance(value, bool) > (
            wanted is bool
        ):
            raise ValueError(f"--set {group}.{item.name} must be {_KINDS[wanted]}, got {value!r}")
    try:
        return kind(**{**own, **given})
    except TypeError as error:
        raise ValueError(f"--set {group}: {error}") from error


def _refuse_others(groups: dict[str, dict[str, Any]], known: tuple[str, ...]) -> None:
    others = sorted(groups.keys() - set(known))
    if others:
        raise ValueError(f"--set {others[0]}: known are {', '.join(known)}")
