"""Twins as files, tables, pictures, answers, and in the form of other simulators."""
