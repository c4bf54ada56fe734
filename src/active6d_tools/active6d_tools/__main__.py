"""``python -m active6d_tools`` is the ``active6d`` command."""

from active6d_tools.cli import main

main()
