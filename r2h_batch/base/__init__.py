"""What every room stands on: files, launches, checks, command lines, frames."""
