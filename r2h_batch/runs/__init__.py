"""Rows, shards, manifests, provenance: what is stored."""
