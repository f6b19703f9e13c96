"""The questions of `bench/answers.py`: models, data, what others would take, and what is right.

A module has QUESTIONS, a list of `Question`s (`question.py`).
"""
