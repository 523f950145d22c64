"""What the words and numbers of a rummaging run mean, for those who see them first."""

GLOSSARY = """\
nll      how badly the belief explains where the object truly is; 0 is perfect, needs the truth
expects  the nll that the belief expects of itself, without the truth: small where its poses agree
apc      mean distance between the object's surfaces at the poses still believed
ess      how many of the poses still count (effective sample size)
agree    seconds to compare the belief with itself, for expects and apc; score: with the truth
r        in figures: how well the arm reaches there, 1 fully; dotted lines are where r is so much
"""

FIGURE = """\
look at  {folder}/overview.png: outlines are poses still believed, from the first view to the end;
         orange is where a touch would tell most; at the end the outlines should be one
"""
