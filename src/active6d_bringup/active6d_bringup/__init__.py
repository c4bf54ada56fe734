"""What runs the graph: composition, recorder, player, reports and the `active6d` command."""
