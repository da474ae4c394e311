"""Bringing data in and out: tables of logs, D4RL files, loaders for other libraries."""
