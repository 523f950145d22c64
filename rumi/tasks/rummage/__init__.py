"""Rummaging (RUMI, arXiv 2408.10450): find an object by pushing it, seen in part or not at all."""
