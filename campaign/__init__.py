"""Chains of commands over settings, and the report that gathers what they answered.

Files:
    sweep              many settings, each by the a90 of trained networks
    sweep_file         the campaign file; sweep_add: one more pair in it
    sweep_settings     feasibility, dose and pace of a setting
    sweep_screening    settings that are trained, when an observer looks first
    sweep_trial        one setting from images to POD
    sweep_runners      where settings are computed
    sweep_choice       which setting to take
    sweep_report       the page of a sweep
    decision           whether a setting meets a requirement; decision_report: its part of the page
    trial              networks trained on one file and tried on another
    ensemble           networks of one recipe in several processes
    table              the paper's table; table_effects: lines with an effect beside it; table_page: its page
    task               POD before and after a diagnosis; task_plan: how large, and of what; task_images: its images;
                       object_material: what its objects are made of; task_page: on the page
    starter            images of the starter network
    chain              commands in order, answers kept
    lab_line           the paper's experiment on the virtual lab: line and images
    demo               the demo; demo_gap: its planted effect; figures, report: its page
    blind_check        sealed cases, top to bottom
    blind_cases        labels and their seal
    blind_measure      the measuring process
    blind_judge        the diagnosing process
    blind_code         the code that is frozen
    blind_results      labels and answers to tables; blind_scores: scores
    blind_separation   separation of effects; blind_statistics: what it needs of a session
    blind_second_day   the gap on another day
    blind_baselines    simple methods on the same cases
    blind_report       the page; blind_figures: its figures
    dataset_page, pod_page, twin_page
                   pages of results
    _children          processes of their own; _leash: their end
    _plain             canonical JSON
    _ticks             ticks of logarithmic axes
"""
