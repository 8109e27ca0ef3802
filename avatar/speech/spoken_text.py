"""Write an English text as it is spoken: numbers, money, dates, times, units, signs, addresses and abbreviations."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable
from re import Match

from avatar.speech.spoken_numbers import (
    spell_cardinal,
    spell_digits,
    spell_money,
    spell_number,
    spell_ordinal,
    spell_time,
    spell_year,
)

_MONTHS = "January February March April May June July August September October November December".split()
# By their first three letters, the form in which dates abbreviate them; "may" and "march" are words, too.
_MONTH = r"(Jan(?:uary|\.)?|Feb(?:ruary|\.)?|March|Mar\.|Apr(?:il|\.)?|May|June?\.?|July?\.?|Aug(?:ust|\.)?" + (
    r"|Sept?(?:ember|\.)?|Oct(?:ober|\.)?|Nov(?:ember|\.)?|Dec(?:ember|\.)?)"
)
# Not within another number, which also keeps the search linear in long runs of digits.
_NUMBER = r"(?<![\d])(?:\d{1,3}(?:,\d{3})+(?!\d)(?:\.\d+)?|\d*\.\d+|\d+)"
_SCALE = r"(?:\s?(thousand|million|billion|trillion|bn|[kKmM](?![\w]))\b)?"
_SCALES = {"bn": "billion", "k": "thousand", "m": "million"}
_CURRENCIES = {
    "$": ("dollar", "dollars", "cent", "cents"),
    "€": ("euro", "euros", "cent", "cents"),
    "£": ("pound", "pounds", "penny", "pence"),
    "¥": ("yen", "yen", "", ""),
    "₹": ("rupee", "rupees", "paisa", "paise"),
}
# Units that follow a number: one, several.
_UNITS = {
    **{"km/h": ("kilometer per hour", "kilometers per hour"), "mph": ("mile per hour", "miles per hour")},
    **{"m/s": ("meter per second", "meters per second"), "km": ("kilometer", "kilometers"), "m": ("meter", "meters")},
    **{"cm": ("centimeter", "centimeters"), "mm": ("millimeter", "millimeters"), "kg": ("kilogram", "kilograms")},
    **{
        "g": ("gram", "grams"),
        "mg": ("milligram", "milligrams"),
        "lb": ("pound", "pounds"),
        "lbs": ("pound", "pounds"),
    },
    **{"oz": ("ounce", "ounces"), "ft": ("foot", "feet"), "mi": ("mile", "miles"), "l": ("liter", "liters")},
    **{"L": ("liter", "liters"), "ml": ("milliliter", "milliliters"), "s": ("second", "seconds")},
    **{"ms": ("millisecond", "milliseconds"), "min": ("minute", "minutes"), "h": ("hour", "hours")},
    **{"hr": ("hour", "hours"), "hrs": ("hour", "hours"), "Hz": ("hertz", "hertz"), "kHz": ("kilohertz", "kilohertz")},
    **{"MHz": ("megahertz", "megahertz"), "GHz": ("gigahertz", "gigahertz"), "KB": ("kilobyte", "kilobytes")},
    **{"kB": ("kilobyte", "kilobytes"), "MB": ("megabyte", "megabytes"), "GB": ("gigabyte", "gigabytes")},
    **{
        "TB": ("terabyte", "terabytes"),
        "W": ("watt", "watts"),
        "kW": ("kilowatt", "kilowatts"),
        "V": ("volt", "volts"),
    },
    **{"kWh": ("kilowatt hour", "kilowatt hours"), "°C": ("degree Celsius", "degrees Celsius")},
    **{"°F": ("degree Fahrenheit", "degrees Fahrenheit"), "°": ("degree", "degrees"), "%": ("percent", "percent")},
}
_UNIT = "|".join(re.escape(one) for one in sorted(_UNITS, key=len, reverse=True))
_FRACTIONS = {2: ("half", "halves"), 3: ("third", "thirds"), 4: ("quarter", "quarters"), 8: ("eighth", "eighths")}
# Abbreviations with their point, which would otherwise end a sentence.
_TITLES = {
    **{"Dr": "doctor", "Mr": "mister", "Mrs": "missus", "Ms": "miz", "Prof": "professor", "Jr": "junior"},
    **{"Sr": "senior", "Gen": "general", "Sgt": "sergeant", "Capt": "captain", "Lt": "lieutenant"},
    **{"Hon": "honorable", "Rev": "reverend", "Gov": "governor"},
}
_ABBREVIATIONS = {
    **{"e.g.": "for example", "i.e.": "that is", "vs.": "versus", "approx.": "approximately", "dept.": "department"},
    **{"Inc.": "incorporated", "Ltd.": "limited", "Co.": "company", "Ave.": "avenue", "Blvd.": "boulevard"},
    **{"w/o": "without", "w/": "with", "etc.": "et cetera", "a.m.": "a m", "p.m.": "p m", "Ph.D.": "p h d"},
}
_SIGNS = {
    **{"&": "and", "+": "plus", "=": "equals", "×": "times", "÷": "divided by", "≈": "about", "±": "plus or minus"},
    **{"<": "less than", ">": "greater than", "≤": "at most", "≥": "at least", "@": "at", "%": "percent"},
    **{"→": "to", "©": "copyright", "√": "square root of"},
}


def speak_text(text: str) -> str:
    """Write numbers, signs and abbreviations of an English text as the words that a speaker says.

    Readings are American: a date of numbers alone is month, day, year. What a rule does not know stays as it is.
    Marks of punctuation remain where they are pauses.

    Args:
        text: any text.

    Example:
        >>> speak_text("It costs $3.50, or 5% more on Nov. 21.")
        'It costs three dollars and fifty cents, or five percent more on November twenty first.'
    """
    # Compatibility characters (fullwidth digits, vulgar fractions) become plain ones, but superscripts keep their
    # meaning, and so do the signs that the rules look for.
    text = text.replace("²", " squared ").replace("³", " cubed ").replace("…", ". ").replace("−", "-")
    text = re.sub(r"(\d)?([¼½¾⅓⅔⅛])", lambda m: f"{m[1] + ' and ' if m[1] else ''}{_vulgar(m[2])}", text)
    text = unicodedata.normalize("NFKC", text).replace("\u2044", "/").replace("’", "'")
    for pattern, replacement in _RULES:
        text = pattern.sub(replacement, text)
    return re.sub(r"\s+(?=[.,;:!?](?:\s|$))", "", " ".join(text.split()))


def _vulgar(sign: str) -> str:
    over, under = unicodedata.normalize("NFKC", sign).split("\u2044")
    words = _fraction(over, under)
    return "a half" if words == "one half" else words


def _fraction(over: str, under: str) -> str:
    """Spell a fraction of small numbers."""
    names = _FRACTIONS.get(int(under)) or (spell_ordinal(under), spell_ordinal(under) + "s")
    return f"{spell_cardinal(over)} {names[int(over) != 1]}"


def _month(name: str) -> str:
    return next(one for one in _MONTHS if one.lower().startswith(name.lower()[:3]))


def _date(match: Match[str]) -> str:
    day, year = match["day"], match["year"]
    return f"{_month(match['month'])} {spell_ordinal(day)}" + (f" {spell_year(year)}" if year else "")


def _date_of_numbers(year: str, month: str, day: str, whole: str) -> str:
    if not (1 <= int(month) <= 12 and 1 <= int(day) <= 31):
        return whole
    return f"{_MONTHS[int(month) - 1]} {spell_ordinal(str(int(day)))} {spell_year(year)}"


def _money(match: Match[str]) -> str:
    scale = (match["scale"] or "").lower()
    return spell_money(match["amount"], _SCALES.get(scale, scale), _CURRENCIES[match["sign"]])


def _gap(match: Match[str]) -> str:
    """Return the space between a number and a word that begins where it ends."""
    return " " if match.string[match.end() : match.end() + 1].isalnum() else ""


def _range_of_money(match: Match[str]) -> str:
    low, high = spell_number(match[2]), spell_money(match[3], "", _CURRENCIES[match[1]])
    return f"{low} to {high}"


def _quantity(match: Match[str]) -> str:
    amount, before = match[1], match.string[: match.start()][-3:]
    # A quantity that describes a thing has its unit in the singular: a five kilometer run.
    describes = re.search(r"\b[Aa]n?\s$", before) and re.match(r"\s[a-z]", match.string[match.end() :])
    return f"{spell_number(amount)} {_UNITS[match[2]][amount != '1' and not describes]}"


def _address(match: Match[str]) -> str:
    """Spell the punctuation of a web or mail address, without its scheme and without the stop that ends a sentence."""
    text = re.sub(r"^(?:https?://)?(?:www\.)?", "", match[0])
    text, stops = text.rstrip(".,;:!?"), re.search(r"[.,;:!?]*$", text)
    for sign, word in (("@", "at"), (".", "dot"), ("/", "slash"), ("-", "dash"), ("_", "underscore")):
        text = text.replace(sign, f" {word} ")
    return text.rstrip() + (stops[0] if stops else "")


def _clock(match: Match[str]) -> str:
    half = (match["half"] or "").replace(".", "").lower()
    words = spell_time(match["hour"], match["minute"] or "00", marked=bool(half))
    # A capital behind the abbreviation's point begins the next sentence.
    ends = (match["half"] or "").endswith(".") and re.match(r"\s*$|\s+[A-Z]", match.string[match.end() :])
    return f"{words} {' '.join(half)}".rstrip() + ("." if ends else "")


Replacement = str | Callable[[Match[str]], str]
_HALF = r"(?P<half>[ap]\.m\.|[aApP]\.?[mM]\b)"
# In the order in which they apply: the more a pattern asks for, the earlier it comes.
_RULES: list[tuple[re.Pattern[str], Replacement]] = [
    (re.compile(pattern), replacement)
    for pattern, replacement in (
        # Parts of names are bounded (RFC 1035, RFC 5321), which keeps the search linear.
        (r"https?://[^\s<>\"')\]]+|www\.[^\s<>\"')\]]+", _address),
        (r"(?<![\w.+-])[\w.+-]{1,64}@[\w-]{1,63}\.[\w.-]{1,255}\b", _address),
        (r"(?<![\w.-])(?:[\w-]{1,63}\.){1,6}(?:com|org|net|edu|gov|io|dev|ai)\b(?:/[\w./-]*)?", _address),
        # Dates and times.
        (r"\b(\d{4})-(\d\d)-(\d\d)\b", lambda m: _date_of_numbers(m[1], m[2], m[3], m[0])),
        (r"\b(\d\d?)/(\d\d?)/((?:19|20)\d\d)\b", lambda m: _date_of_numbers(m[3], m[1], m[2], m[0])),
        (rf"\b(?P<month>{_MONTH})\s(?P<day>[12]?\d|3[01])(?:st|nd|rd|th)?\b(?:,?\s(?P<year>[12]\d{{3}})\b)?", _date),
        (rf"\b(?P<day>[12]?\d|3[01])(?:st|nd|rd|th)?\s(?P<month>{_MONTH})\b(?:,?\s(?P<year>[12]\d{{3}})\b)?", _date),
        (rf"\b(?P<hour>[01]?\d|2[0-3]):(?P<minute>[0-5]\d)(?!\d|:)(?:\s?{_HALF})?", _clock),
        (rf"\b(?P<hour>[01]?\d)(?P<minute>)\s?{_HALF}", _clock),
        (r"\b((?:1[1-9]|20)\d)0s\b", lambda m: re.sub(r"y$", "ie", spell_year(m[1] + "0")) + "s"),
        (
            rf"(?i)\b(in|since|until|till|before|after|from|by|year|of|{_MONTH[1:-1]})(,?\s)((?:1[1-9]|20)\d\d)\b(?![.,]?\d)",
            lambda m: f"{m[1]}{m[2]}{spell_year(m[m.lastindex or 3])}",
        ),
        # Money, quantities, ordinals, ranges.
        (rf"([$€£¥₹])({_NUMBER})\s?[-\u2013]\s?\1?({_NUMBER})", _range_of_money),
        (rf"(?P<sign>[$€£¥₹])\s?(?P<amount>{_NUMBER}){_SCALE.replace('(thou', '(?P<scale>thou')}", _money),
        (rf"(?P<amount>{_NUMBER})(?P<scale>)\s?(?P<sign>[$€£¥₹])", _money),
        (r"\b(\d)'\s?(\d\d?)(?:\"|\b)", lambda m: f"{spell_cardinal(m[1])} foot {spell_cardinal(m[2])}"),
        (rf"({_NUMBER})\s?in\.(?=\s[a-z])", lambda m: f"{spell_number(m[1])} {'inch' if m[1] == '1' else 'inches'}"),
        (r"\b24/7\b", "twenty four seven"),
        (r"(?<=\d)\s?x\s?(?=\d)", " by "),
        (r"(?<=\d)x\b", " times"),
        (r"(?<=[\w)])\^(?=\d)", " to the power of "),
        (r"\b(\d{3})-(\d{4})\b", lambda m: f"{spell_digits(m[1])}, {spell_digits(m[2])}"),
        (rf"({_NUMBER})\s?[-\u2013]\s?(?={_NUMBER})", r"\1 to "),
        (rf"(?<![\w.)])[-\u2013](?=(?:{_NUMBER}))", "minus "),
        (rf"(?<![\w.])({_NUMBER})\s?({_UNIT})(?![\w/])", _quantity),
        (r"\b(\d+)(?:st|nd|rd|th)\b", lambda m: spell_ordinal(m[1])),
        (r"(?<![\d/.])([1-9])/([2-9]|10|16|32|64|100)(?![\d/])", lambda m: _fraction(m[1], m[2])),
        (r"(?<=\d)/(?=\d)", " over "),
        (r"#(?=\d)", "number "),
        (r"\bNo\.\s?(?=\d)", "number "),
        (
            r"(?<![\d.])\d+(?:\.\d+){2,}(?![\w.]\w)",
            lambda m: " " + " point ".join(spell_cardinal(one) for one in m[0].split(".")),
        ),
        (rf"(?<![\w.])({_NUMBER})(?![\d])", lambda m: spell_number(m[1]) + _gap(m)),
        (r"\d+", lambda m: f" {spell_cardinal(m[0])} "),
        # Abbreviations and signs. A street follows its name; a saint stands before hers.
        (r"\bSt\.(?=\s[A-Z])", "saint"),
        (r"\bSt\.", "street."),
        (rf"\b({'|'.join(_TITLES)})\.", lambda m: _TITLES[m[1]]),
        (
            rf"(?<![\w.])({'|'.join(re.escape(one) for one in _ABBREVIATIONS)})(?!\w)(?=\s*$|\s+[A-Z]|(.)|)",
            lambda m: _ABBREVIATIONS[m[1]] + ("." if m[1] == "etc." and m[0] and not m[2] else ""),
        ),
        (r"\b(?:[A-Za-z]\.){2,}", lambda m: " ".join(m[0].replace(".", " ").split())),
        (r"\band/or\b", "and or"),
        (r"(?<=\w)/(?=\w)", " or "),
        (r"(?<=\w)\*(?=\s?\w)|\s\*\s(?=\w)", " times "),
        (f"[{re.escape(''.join(_SIGNS))}]", lambda m: f" {_SIGNS[m[0]]} "),
    )
]
