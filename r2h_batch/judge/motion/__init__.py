"""The time law, and engines that move the arm."""
