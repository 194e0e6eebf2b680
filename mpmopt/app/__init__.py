"""Cases, several starts, sweeps: what scripts and commands do."""
