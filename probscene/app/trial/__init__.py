"""``probscene trial``: what is a labelled set worth to a detector?"""
