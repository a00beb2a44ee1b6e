"""Tables, charts, pages of a run folder."""
