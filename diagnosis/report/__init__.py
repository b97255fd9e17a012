"""The answer in words and pictures.

Files:
    words         of probes, nuisances, strengths
    explanation   a headline, a table, a sentence for each thing to be said
    figures       gap maps, curves, hypotheses
    report        the page
"""
