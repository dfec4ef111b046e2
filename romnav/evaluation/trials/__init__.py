"""Trials in scenes, with the safety filter off and on (paper, Sec. IV-C, IV-D)."""
