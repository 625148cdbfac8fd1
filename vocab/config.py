"""Settings of the vocabulary room."""

from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator


class VocabConfig(BaseModel):
    """How places are described, compared and ranked.

    The weights say how far each cue is believed: a place's score is the weighted mean of its votes, of the likeness of
    its histograms and of the likeness of its view, each in 0..1. Histograms follow the light, so by default they have
    half the say of the votes among unrelated places (over generated images the votes spread by 0.025, the likeness by
    0.13); under generated changes of light any larger weight cost more than it gained. The view, edges on a coarse
    grid, hardly minds light, but minds another direction of the camera, which the votes forgive. The votes of an image
    with few features are mostly chance and count less.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    max_descriptors: int = Field(
        default=2000, ge=1, description="At most this many descriptors of an image, its first, become words."
    )
    candidates: int = Field(default=10, ge=1, description="How many places a query returns at most.")
    exclude_recent_s: float = Field(
        default=5.0,
        ge=0.0,
        description="Places of the same session nearer in time than this are not candidates, in seconds.",
    )
    exclude_recent_count: int = Field(
        default=8, ge=0, description="The last so many places of a session are not candidates."
    )
    exclude_covisible: float = Field(
        default=0.5,
        gt=0.0,
        le=1.0,
        description="The last places of a session are not candidates as long as their votes are at least so high: the "
        "camera has not moved on. 1 leaves it out.",
    )
    exclude_recent_count_places: int = Field(
        default=20,
        ge=0,
        description="Takes the place of both in mode places, where stamps are a running index and tell no motion.",
    )
    votes_weight: float = Field(default=1.0, ge=0.0, description="Weight of the visual words in the score.")
    histogram_weight: float = Field(default=0.1, ge=0.0, description="Weight of the colour histograms in the score.")
    view_weight: float = Field(default=0.4, ge=0.0, description="Weight of the view, the edges of the whole image.")
    trusted_features: int = Field(
        default=200, ge=1, description="With fewer features than this an image's votes count proportionally less."
    )
    soft_words: int = Field(
        default=1,
        ge=1,
        le=8,
        description="A query's features vote for so many words each, the nearest ones; places keep the nearest alone.",
    )
    signatures: bool = Field(
        default=False,
        description="Keep 64 bits of each feature, so that only features alike within a word vote; 8 bytes more each.",
    )
    geometry: bool = Field(
        default=False,
        description="Of features alike within a word only those vote whose scale and orientation have changed as most "
        "have; takes signatures, 2 bytes more for each feature.",
    )
    histogram_bins: int = Field(default=32, ge=4, le=256, description="Bins of each of the six histograms.")
    histogram_sigma_bins: float = Field(
        default=1.0,
        ge=0.0,
        le=16.0,
        description="Standard deviation of the Gaussian that smooths the histograms, in bins.",
    )

    @model_validator(mode="after")
    def _some_cue_counts(self) -> Self:
        if self.votes_weight + self.histogram_weight + self.view_weight <= 0.0:
            raise ValueError("votes_weight, histogram_weight and view_weight must not all be 0")
        if self.signatures and self.soft_words > 1:
            raise ValueError("signatures belong to the nearest word: soft_words must be 1 with them")
        if self.geometry and not self.signatures:
            raise ValueError("geometry refines the votes of signatures: signatures must be true with it")
        return self
