"""The folder of a training: a training that is there is not replaced by mistake."""

from pathlib import Path

from active6d_core.files import make_folder


def refuse_begun(folder: Path, *, resume: bool, again: bool) -> None:
    """Refuse to start in the folder of another training, which would lose its curve and its best weights.

    Args:
        folder: of the training.
        resume: the training that is there goes on.
        again: the training that is there may be replaced.

    Raises:
        ValueError: there is a training and neither is wanted, or both are.
    """
    if resume and again:
        raise ValueError("--resume continues the training that is there and --again replaces it; give one of them")
    if not (resume or again) and (folder / "latest.json").is_file():
        raise ValueError(
            f"{folder} already holds a training; continue it with --resume, replace it with --again, "
            "or choose another folder"
        )


def begin_training(folder: Path, *, resume: bool = False, again: bool = False) -> None:
    """Make the folder of a training; unless it is resumed, nothing of an earlier one's progress is left.

    For its arguments and errors see :func:`refuse_begun`.
    """
    refuse_begun(folder, resume=resume, again=again)
    make_folder(folder)
    if not resume:
        # Without the checkpoint, a start that is interrupted early cannot be resumed as the earlier training.
        for name in ("curve.jsonl", "latest.json"):
            (folder / name).unlink(missing_ok=True)
