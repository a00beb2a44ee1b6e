"""Where a margin is attained, and its first-order change."""
