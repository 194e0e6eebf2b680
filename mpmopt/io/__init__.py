"""Files, locks, checksums, and what is said on the terminal."""
