"""Conducts the parts: which experiments there are, which stages they need, where their results lie."""
