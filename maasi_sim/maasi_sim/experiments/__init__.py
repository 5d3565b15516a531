"""The papers' experiments: what is run, how it is measured, and what the papers report.

`cases` and `experiment` define what an experiment is, `registry` lists them, `campaign` runs them
and `results` stores the runs. `statistics`, `tables` and `figures` compare them with the paper.
One module per paper holds its experiments.
"""
