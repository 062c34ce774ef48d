"""Experiments: one script a published table or figure. Each prints its numbers and saves pictures.

`python -m experiments.NAME --out FOLDER`; `--tiny` is the size that the tests run.
"""
