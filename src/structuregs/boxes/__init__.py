"""Clouds to boxes matched across states, with hypotheses for their motions."""
