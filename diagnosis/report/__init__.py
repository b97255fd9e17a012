"""The answer in words and pictures.

Files:
    explanation   one paragraph
    figures       gap maps, curves, hypotheses
    report        the page
"""
