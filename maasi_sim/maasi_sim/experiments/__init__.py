"""The papers' experiments, and comparisons of searches.

`experiment` defines what an experiment is, `papers` reads those of the papers, `campaign` makes
and keeps their runs (`runs`); `tables`, `figures` and `outputs` show them.
"""
