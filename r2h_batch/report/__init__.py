"""Tables, charts, pages, statistics and comparisons of run folders."""
