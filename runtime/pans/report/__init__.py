"""What people look at: the summary of a run, pages, comparisons, the live view, and what a file holds.

In: the result of a run, recordings, bundles, calibrations. Out: figures, words, verdicts and pages.
Other rooms import summary, files, pages, compare and live_view.
Start at summary/summary.py: PASS or FAIL, with a sentence for each fault.
"""
