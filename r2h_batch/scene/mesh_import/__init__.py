"""What becomes of a user's object before it is one of ours: its mesh closed, its labels carried
over, its build kept."""
