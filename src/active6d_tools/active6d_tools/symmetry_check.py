"""Whether a mesh has the symmetries that a user names, and which it seems to have."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from active6d_core.object_model import ObjectModel, Symmetry
from active6d_core.rotation_group import rotation_group
from active6d_core.se3 import rotation_angle
from active6d_perception.model.exact_symmetry import SHARE, ExactSymmetries, Turn, TurnedSurface, exact_symmetries

#: Share of the diameter by which a surface may leave itself, turned by any angle about an axis of symmetry. It is .03
#: for a bolt with a hexagonal head.
_AXIS_TOLERANCE = 0.05
#: The same for parts of a turn. A scan of a symmetric part may deviate more than what is suggested; a hexagonal nut
#: turned by less or more than a sixth deviates by .04.
_TURN_TOLERANCE = 0.02
_MOST_FOLDS = 60
_SAME_ANGLE = np.radians(2.0)
_PARTS = {
    2: "half a",
    3: "a third of a",
    4: "a quarter of a",
    5: "a fifth of a",
    6: "a sixth of a",
    8: "an eighth of a",
}


def parse_turn(text: str) -> Turn:
    """The symmetry ``AXIS:FOLD`` that an option names: ``z:6`` or ``0.6,0.8,0:2``.

    Raises:
        ValueError: the axis is not x, y, z or three numbers, or the fold is not a number from 2 to 60.
    """
    axis_text, _, fold_text = text.strip().rpartition(":")
    try:
        axis = np.eye(3)[["x", "y", "z"].index(axis_text)] if axis_text.isalpha() else _numbers(axis_text)
        fold, length = int(fold_text), float(np.linalg.norm(axis))
    except ValueError:
        axis, fold, length = np.zeros(0), 0, 0.0
    if axis.shape != (3,) or not 0 < length < np.inf or not 2 <= fold <= _MOST_FOLDS:
        raise ValueError(
            f"--symmetry '{text}': write AXIS:FOLD, such as z:6 for a sixth of a turn about z or 0.6,0.8,0:2 for half "
            f"a turn about that axis; FOLD is from 2 to {_MOST_FOLDS}"
        )
    return Turn(axis / length, fold)


def rotation_vectors(turns: Sequence[Turn]) -> list[list[float]]:
    """All rotations but the identity that turns generate, as rotation vectors in degrees.

    Raises:
        ValueError: the turns do not fit together.
    """
    try:
        group = rotation_group(np.concatenate([turn.rotations for turn in turns]))
    except ValueError as error:
        raise ValueError(f"{_options(None, turns)}: {error}") from error
    vectors: list[list[float]] = (Rotation.from_matrix(group[1:]).as_rotvec(degrees=True).round(4) + 0.0).tolist()
    return vectors


def refuse_wrong_axis(model: ObjectModel) -> None:
    """Refuse an axis about which the mesh cannot be turned.

    Args:
        model: an object with an axis of continuous symmetry.

    Raises:
        ValueError: the turned surface leaves the surface; the text has the distance and the axes that would do.
    """
    if model.symmetry.axis is None:
        return
    deviation, allowed = TurnedSurface(model).deviation_about(model.symmetry.axis), _AXIS_TOLERANCE * model.diameter
    if deviation <= allowed:
        return
    fits = axes_of_symmetry(model)
    advice = f"--axis can be {' or '.join(fits)}" if fits else "none of x, y and z is one, so leave --axis out"
    raise ValueError(f"--axis is no axis of symmetry: turned about it {_moved(deviation, allowed)}; {advice}")


def refuse_wrong_turns(model: ObjectModel, turns: Sequence[Turn]) -> None:
    """Refuse discrete symmetries that the mesh does not have.

    Args:
        model: an object with the discrete symmetries that ``turns`` generate.
        turns: as the user named them.

    Raises:
        ValueError: a turned surface leaves the surface; the text has the distance and the symmetries that were found.
    """
    surface, allowed = TurnedSurface(model), _TURN_TOLERANCE * model.diameter
    # A turn that does not hold is named before its products with others.
    for name, rotations in [
        *((_options(None, [turn]), turn.rotations) for turn in turns),
        (_options(None, turns), model.symmetry.discrete),
    ]:
        deviations = surface.deviations(rotations)
        worst = int(deviations.argmax())
        if deviations[worst] <= allowed:
            continue
        found = exact_symmetries(model)
        advice = "no symmetry was found, so leave --symmetry out"
        if found.turns or found.axis is not None:
            advice = f"what was found is {_options(found.axis, found.turns)}"
        vector = Rotation.from_matrix(rotations[worst]).as_rotvec(degrees=True)
        degrees = float(np.linalg.norm(vector))
        raise ValueError(
            f"{name} does not hold: turned by {degrees:.0f} degrees about {_name(vector / degrees)} "
            f"{_moved(deviations[worst], allowed)}; {advice}"
        )


def axes_of_symmetry(model: ObjectModel) -> list[str]:
    """Those of x, y and z about which the mesh can be turned, with the numbers that name them: "x (1 0 0)"."""
    surface, allowed = TurnedSurface(model), _AXIS_TOLERANCE * model.diameter
    axes = zip(("x (1 0 0)", "y (0 1 0)", "z (0 0 1)"), np.eye(3), strict=True)
    return [name for name, axis in axes if surface.deviation_about(axis) <= allowed]


def symmetry_notes(model: ObjectModel) -> list[str]:
    """What a user should know of symmetries that a mesh seems to have and its description does not declare."""
    found = exact_symmetries(model)
    notes: list[str] = []
    if not _declares(model.symmetry, found):
        axis = model.symmetry.axis if found.axis is None else found.axis
        turns = [turn for turn in found.turns if axis is None or abs(turn.axis @ axis) < np.cos(_SAME_ANGLE)]
        words = [] if axis is None else [f"any turn about {_name(axis)}"]
        words += [f"{_PARTS.get(turn.fold, f'1/{turn.fold} of a')} turn about {_name(turn.axis)}" for turn in turns]
        notes.append(
            f"it looks the same after {' and '.join(words)}; if {'this does' if len(words) == 1 else 'these do'} not "
            f"matter, add it again with another --name and {_options(axis, turns)}"
        )
    if found.axis is None and model.symmetry.axis is None and len(model.symmetry.discrete) == 1:
        fits = axes_of_symmetry(model)
        if fits:
            notes.append(f"it looks nearly round about {' and '.join(fits)}; if no turn about it matters, add --axis")
    return notes


def _declares(symmetry: Symmetry, found: ExactSymmetries) -> bool:
    """Whether a description declares all that was found."""
    if found.axis is not None and (symmetry.axis is None or abs(symmetry.axis @ found.axis) < np.cos(_SAME_ANGLE)):
        return False
    for R in (turn.rotations[0] for turn in found.turns):
        if symmetry.axis is None:
            declared = rotation_angle(symmetry.discrete, R) < _SAME_ANGLE
        else:  # with any turn about the axis before and after
            declared = symmetry.discrete @ symmetry.axis @ (R @ symmetry.axis) > np.cos(_SAME_ANGLE)
        if not declared.any():
            return False
    return True


def _numbers(text: str) -> np.ndarray:
    return np.array([float(value) for value in text.split(",")])


def _moved(deviation: float, allowed: float) -> str:
    return (
        f"through the centroid, {1 - SHARE:.0%} of the surface move by {1e3 * deviation:.1f} mm or more, "
        f"{1e3 * allowed:.1f} mm are allowed"
    )


def _name(axis: np.ndarray) -> str:
    """``z``, or three numbers with commas, as :func:`parse_turn` reads it."""
    nearest = int(np.abs(axis).argmax())
    if axis[nearest] > 1 - 1e-6:
        return "xyz"[nearest]
    return ",".join(f"{value:.4f}".rstrip("0").rstrip(".") for value in axis + 0.0)


def _options(axis: np.ndarray | None, turns: Sequence[Turn]) -> str:
    """The options of ``active6d object add`` that declare an axis of any turn and discrete symmetries."""
    options = [] if axis is None else ["--axis " + " ".join(f"{value:.4g}" for value in axis)]
    return " ".join([*options, *(f"--symmetry {_name(turn.axis)}:{turn.fold}" for turn in turns)])
