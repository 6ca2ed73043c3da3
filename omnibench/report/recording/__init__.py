"""Pictures of a recording: the room with scans and paths, wheels against their targets, a run step by step."""
