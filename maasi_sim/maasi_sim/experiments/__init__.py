"""The papers' experiments, and comparisons of searches.

`experiment` defines what an experiment is, `papers` reads those of the papers, `campaign` makes
their runs by `workers`, and `runs` stores them; `tables`, `figures` and `outputs` show them.
"""
