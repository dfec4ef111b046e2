"""Tables and figures of trials in scenes."""
