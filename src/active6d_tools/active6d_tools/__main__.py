"""``python -m active6d_tools`` is the ``active6d`` command."""

from active6d_tools.command import main

main()
