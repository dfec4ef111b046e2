"""The report of a scale: one page with every table, curve and episode, complete in itself."""
