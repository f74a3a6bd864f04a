"""`potserver atoms build`: recordings to candidate atoms, on many processors, and a cover of those to a dictionary.

`recipe` says what is built, `scan_task` learns one scan's atoms wherever it runs, `engines` runs such tasks on processes or
on Ray, `builder` puts them together.
"""
