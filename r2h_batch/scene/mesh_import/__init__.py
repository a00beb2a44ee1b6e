"""A user's object made fit for judging: its mesh closed, its labels carried over, its build
kept."""
