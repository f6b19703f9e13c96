"""The models that the tests share, each declared once, so that each is compiled once.

standard.py     what the statistical checks run on, with matrices of the linear ones by hand
wider.py        several experiments, gaps, feedback: for calibration
statements.py   one model for each kind of statement that is generated and compiled
kalman.py       linear Gaussian ones of every shape
finite.py       states of finitely many values
conditional.py  linear Gaussian given the rest
twisted.py      for the lookahead of the twisted proposals
noise.py        drives by noises: what Gibbs interweaves
em.py           for the M-step
elimination.py  parameters that are integrated out
checkpoints.py  small ones, for interrupted runs
gaps.py         systems with and without an unmodelled effect
"""
