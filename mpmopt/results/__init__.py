"""What a run leaves: its file, drawings, solids, motion."""
