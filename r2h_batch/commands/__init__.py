"""Commands, a file each. Those of `sweep`, `results` and `study` lie in sweep/, `view` and `why` in view/."""
