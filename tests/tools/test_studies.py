"""Every study is a command with help and an example that fits its arguments."""

import importlib
import pkgutil
import shlex

import pytest

from active6d_tools import studies
from active6d_tools.studies import arguments

STUDIES = sorted({module.name for module in pkgutil.iter_modules(studies.__path__)} - {"arguments"})


class Parsed(Exception):
    """Raised in place of what a study does with its arguments."""


@pytest.mark.parametrize("name", STUDIES)
def test_help_has_an_example_that_is_accepted(name, monkeypatch, capsys):
    study = importlib.import_module(f"{studies.__name__}.{name}")
    monkeypatch.setattr("sys.argv", [name, "--help"])
    with pytest.raises(SystemExit) as ended:
        study.main()
    assert ended.value.code == 0
    command = f"python -m {study.__name__} "
    shown = capsys.readouterr().out.partition("Example: ")[2].partition("\n\n")[0]
    assert shown.startswith(command)

    def stop(*given, **options):
        raise Parsed(*given)

    for module in (study, arguments):
        monkeypatch.setattr(module, "load_object", stop, raising=False)
    for reads in ("load_bank", "find_bank", "read_split"):
        monkeypatch.setattr(study, reads, stop, raising=False)
    monkeypatch.setattr("sys.argv", [name, *shlex.split(shown.removeprefix(command))])
    with pytest.raises(Parsed) as parsed:
        study.main()
    assert parsed.value.args[0] in ("mug", "coffee_cup")
