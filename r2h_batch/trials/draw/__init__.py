"""How trials are drawn: the rule, who the receivers are, and where their hands may stand."""
