"""Commands, a file each; `export` has one for each of its kinds. Those of `sweep`, `results` and `study` lie in sweep/, `view`
and `why` in view/."""
