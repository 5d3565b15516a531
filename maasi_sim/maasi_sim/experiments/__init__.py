"""The papers' experiments: what is run, how it is measured, and what the papers report.

`registry` names them, `campaign` runs them, `results` keeps the runs, `statistics`, `tables` and
`figures` make of them what can be laid beside the paper. One module per paper holds its
experiments.
"""
