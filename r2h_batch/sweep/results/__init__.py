"""Stored rows checked, judged again and counted again."""
