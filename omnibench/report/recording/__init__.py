"""The report on a recording: room, scans and paths, wheel rates against targets, a run step by step."""
