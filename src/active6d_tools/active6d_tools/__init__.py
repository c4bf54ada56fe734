"""The `active6d` command, benchmarks, reports, results and studies."""
