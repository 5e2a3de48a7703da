"""What is done with a recorded session: replay, re-simulation, report, export, repair."""
