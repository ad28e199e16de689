"""Tokenizer of CLIP: byte pair encoding of lower-case text (Radford 2021, section 2.4; Sennrich 2016)."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from functools import cache

import torch
from jaxtyping import Int
from torch import Tensor

from ...errors import LumigraphError

BEGIN, END = "<|startoftext|>", "<|endoftext|>"
WORD_END = "</w>"
# CLIP's pieces: contractions, words, single digits, and everything else.
PIECES = re.compile(r"'s|'t|'re|'ve|'m|'ll|'d|[^\W\d_]+|\d|(?:[^\s\w]|_)+", re.IGNORECASE)


class Tokenizer:
    """Token numbers of captions, with begin and end tokens.

    vocabulary: number of each token
    merges:     pairs of tokens to merge, the most frequent first
    context:    number of tokens of a caption
    padding:    token after the end
    """

    def __init__(
        self, vocabulary: dict[str, int], merges: Sequence[tuple[str, str]], context: int = 77, padding: str = END
    ):
        self.vocabulary, self.context, self.padding = vocabulary, context, vocabulary[padding]
        self.merges = list(merges)
        self.ranks = {pair: rank for rank, pair in enumerate(merges)}

    def __call__(self, captions: Sequence[str]) -> Int[Tensor, "caption token"]:
        """Tokens of captions. Raises LumigraphError for an empty caption, or a script without tokens."""
        rows = []
        for caption in captions:
            tokens = [number for piece in self.pieces(caption) for number in self.numbers(piece, caption)]
            tokens = [self.vocabulary[BEGIN], *tokens[: self.context - 2], self.vocabulary[END]]
            rows.append(tokens + [self.padding] * (self.context - len(tokens)))
        return torch.tensor(rows)

    @staticmethod
    def pieces(caption: str) -> list[str]:
        found = PIECES.findall(html.unescape(caption).lower())
        return found

    def numbers(self, piece: str, caption: str) -> list[int]:
        """Numbers of a piece's tokens."""
        parts = self.merged(piece)
        foreign = not piece.isascii() and piece.isalpha() and len(parts) >= len(piece.encode())
        if foreign or any(part not in self.vocabulary for part in parts):
            raise LumigraphError(
                f"The tokenizer of the guidance has no tokens for {piece!r} in {caption!r}; write the prompt in the "
                "language and script of its captions"
            )
        return [self.vocabulary[part] for part in parts]

    def merged(self, piece: str) -> list[str]:
        """Tokens of a piece: its bytes, merged pair by pair."""
        parts = [byte_names()[byte] for byte in piece.encode()]
        parts[-1] += WORD_END
        while len(parts) > 1:
            pairs = list(zip(parts, parts[1:], strict=False))
            best = min(pairs, key=lambda pair: self.ranks.get(pair, len(self.ranks)))
            if best not in self.ranks:
                break
            joined, i = list[str](), 0
            while i < len(parts):
                both = tuple(parts[i : i + 2]) == best
                joined.append("".join(best) if both else parts[i])
                i += 2 if both else 1
            parts = joined
        return parts

    @staticmethod
    def of_words(words: Iterable[str], context: int) -> Tokenizer:
        """A tokenizer with one token for each of some words, and for their letters."""
        names = dict.fromkeys(x for word in words for letter in word for x in (letter, letter + WORD_END))
        merges = dict[tuple[str, str], None]()
        for word in words:
            parts = [*word[:-1], word[-1] + WORD_END]
            for i in range(1, len(parts)):
                merges["".join(parts[:i]), parts[i]] = None
        names |= dict.fromkeys("".join(pair) for pair in merges)
        return Tokenizer({x: i for i, x in enumerate([*names, BEGIN, END])}, list(merges), context)


@cache
def byte_names() -> list[str]:
    """Printable character for each byte, as in GPT-2's and CLIP's vocabularies."""
    shown = {*range(33, 127), *range(161, 173), *range(174, 256)}
    hidden = [byte for byte in range(256) if byte not in shown]
    return [chr(byte) if byte in shown else chr(256 + hidden.index(byte)) for byte in range(256)]
