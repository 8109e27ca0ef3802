"""English number words: cardinals, ordinals, decimals, years, times, and sums of money."""

from __future__ import annotations

_ONES = (
    "zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen sixteen seventeen "
    "eighteen nineteen"
).split()
_TENS = "twenty thirty forty fifty sixty seventy eighty ninety".split()
# Short scale, in which a billion has nine zeros.
_SCALES = ((10**12, "trillion"), (10**9, "billion"), (10**6, "million"), (1000, "thousand"), (100, "hundred"))
_IRREGULAR_ORDINALS = {
    **{"one": "first", "two": "second", "three": "third", "five": "fifth"},
    **{"eight": "eighth", "nine": "ninth", "twelve": "twelfth"},
}


def spell_digits(digits: str) -> str:
    """Spell ASCII digits one by one.

    Example:
        >>> spell_digits("007")
        'zero zero seven'
    """
    return " ".join(_ONES[int(one)] for one in digits)


def spell_cardinal(digits: str) -> str:
    """Spell a whole number without sign; digit by digit if it begins with a zero or has more than 15 digits.

    Args:
        digits: ASCII digits without separators.

    Example:
        >>> spell_cardinal("100245")
        'one hundred thousand two hundred forty five'
    """
    # Few listeners know the names of longer numbers, and Python refuses to parse very long ones.
    most_digits = 15
    if len(digits) > most_digits or (len(digits) > 1 and digits[0] == "0"):
        return spell_digits(digits)
    return " ".join(_words(int(digits)))


def spell_ordinal(digits: str) -> str:
    """Spell the ordinal of a whole number.

    Example:
        >>> spell_ordinal("21")
        'twenty first'
    """
    *front, last = spell_cardinal(digits).split()
    if last in _IRREGULAR_ORDINALS:
        last = _IRREGULAR_ORDINALS[last]
    else:
        last = last[:-1] + "ieth" if last.endswith("y") else last + "th"
    return " ".join([*front, last])


def spell_number(text: str) -> str:
    """Spell a number with separators of thousands, a fraction after a point, or both.

    Example:
        >>> spell_number("1,250.05")
        'one thousand two hundred fifty point zero five'
    """
    whole, _, fraction = text.replace(",", "").partition(".")
    out = spell_cardinal(whole) if whole else ""
    return f"{out} point {spell_digits(fraction)}".strip() if fraction else out


def spell_year(digits: str) -> str:
    """Spell a year of four digits by its halves, as English does except for 2000 to 2009.

    Example:
        >>> spell_year("1905"), spell_year("2007"), spell_year("2026")
        ('nineteen oh five', 'two thousand seven', 'twenty twenty six')
    """
    century, rest = int(digits[:2]), int(digits[2:])
    if century % 10 == 0 and rest < 10:
        return spell_cardinal(digits)
    if rest == 0:
        return f"{spell_cardinal(digits[:2])} hundred"
    return f"{spell_cardinal(digits[:2])} {'oh ' if rest < 10 else ''}{spell_cardinal(str(rest))}"


def spell_time(hour: str, minute: str, *, marked: bool) -> str:
    """Spell a time of the day.

    Args:
        hour: one or two digits.
        minute: two digits.
        marked: whether a.m. or p.m. follows, in whose place a full hour otherwise has "o'clock".

    Example:
        >>> spell_time("3", "05", marked=False), spell_time("12", "00", marked=False)
        ('three oh five', "twelve o'clock")
    """
    hour_words = spell_cardinal(str(int(hour)))
    if minute == "00":
        return hour_words if marked else f"{hour_words} o'clock"
    return f"{hour_words} {'oh ' if minute[0] == '0' else ''}{spell_cardinal(str(int(minute)))}"


def spell_money(amount: str, scale: str, names: tuple[str, str, str, str]) -> str:
    """Spell a sum of money.

    Args:
        amount: with separators of thousands and a fraction.
        scale: "million" and the like, or "".
        names: of the currency, one and several, and of its hundredth part, one and several ("" where it has none).

    Example:
        >>> spell_money("3.50", "", ("dollar", "dollars", "cent", "cents"))
        'three dollars and fifty cents'
    """
    whole, _, fraction = amount.replace(",", "").partition(".")
    if scale or not names[2] or (fraction and len(fraction) != 2):
        return f"{spell_number(amount)} {scale} {names[1]}".replace("  ", " ")
    hundredths = int(fraction or "0")
    parts = [f"{spell_cardinal(whole)} {names[0] if int(whole) == 1 else names[1]}"] if int(whole or "0") else []
    if hundredths:
        parts.append(f"{spell_cardinal(str(hundredths))} {names[2] if hundredths == 1 else names[3]}")
    return " and ".join(parts) or f"zero {names[1]}"


def _words(value: int) -> list[str]:
    if value < 20:
        return [_ONES[value]]
    if value < 100:
        return [_TENS[value // 10 - 2], *([_ONES[value % 10]] if value % 10 else [])]
    size, name = next((size, name) for size, name in _SCALES if value >= size)
    return [*_words(value // size), name, *(_words(value % size) if value % size else [])]
