"""Tables and listings of paired episodes."""
