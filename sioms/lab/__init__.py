"""What the laboratories of fingers and of reconcile share: arrays out of files, pages of reports, axes that press and
how they stop.
"""
