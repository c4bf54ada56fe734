"""``python -m active6d_bringup`` is the ``active6d`` command."""

from active6d_bringup.cli import main

main()
