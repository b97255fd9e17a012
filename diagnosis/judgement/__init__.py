"""Which explanation leads, how well it fits, how strong each effect is, and the answer.

Files:
    judgement   hypotheses to verdict, causes and twin
    strengths   strength of an effect with its interval
    held_out    gap left on series that the fit did not use
    answer      the answer and its file
"""
