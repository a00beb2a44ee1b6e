"""Stored rows checked, judged again and counted again.

judge.py has the evaluator of a run folder, and questions.py the loop that judges stored poses again with it. What is asked
of them is a `Question` in a file of its own: reevaluation.py (is each row what a sweep would store?) and reception.py.
"""
