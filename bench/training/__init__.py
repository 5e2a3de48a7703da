"""Emulated people at the exercises: how well the score tells novices from experts."""
