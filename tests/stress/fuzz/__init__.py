"""Fuzz: public functions, files, settings and command lines under input that nobody meant."""
