"""Stages that need each other: what is out of date, what made it, and running it. Knows no kind of stage."""
