"""The paper's comparisons on data of ours: which models, trained and scored how, and what the paper found.

plan.py      the studies and their contestants
paper.py     the paper's numbers
training.py  one contestant's `train-worldmodel` run, in a process of its own
scoring.py   one contestant's evaluation
results.py   study.json
findings.py  what the numbers say, in sentences
report.py    study.md
figures.py   curves and bars
"""
