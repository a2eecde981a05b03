"""Simulate the log of a publisher, whose articles live for two or three days.

    python examples/make_news_log.py news

writes to the folder `news`:

- `impressions.parquet`: one row per article shown, in pages of four. One session in ten is shown
  articles drawn evenly from those that are alive, with their `propensity`; the others an editor's
  choice, without;
- `articles.csv`: `article`, `section`, `published_at` and `expires_at`;
- `news.toml`: the mapping for `ucfrec prepare --mapping`.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

SECTIONS = ("politics", "sport", "culture", "science", "local", "video")
DAYS, VISITORS, ARTICLES, PAGE, LONGEST = 14, 3_000, 300, 4, 6
START = pd.Timestamp("2026-10-05", tz="UTC")
MAPPING = """\
reward = "clicked"

[columns]
user_id = "visitor"
item_id = "article"
timestamp = "shown_at"
request_id = "page"

[[item_features]]
files = ["articles.csv"]
key = "article"
columns = ["section"]
available_from = "published_at"
available_until = "expires_at"
"""


class News:
    """Visitors with tastes for sections, and articles that interest less by the hour."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.taste = rng.dirichlet(np.full(len(SECTIONS), 0.5), VISITORS)
        self.section = rng.integers(len(SECTIONS), size=ARTICLES)
        self.quality = rng.normal(0, 0.8, ARTICLES)
        self.published = np.sort(rng.uniform(-48, 24 * DAYS, ARTICLES))
        self.expires = self.published + rng.choice([48, 60, 72], ARTICLES)

    def alive(self, hour: float) -> np.ndarray:
        """Articles that may be shown at an hour after `START`."""
        return np.flatnonzero(self.is_alive(slice(None), hour))

    def is_alive(self, articles: np.ndarray | slice, hour: float | np.ndarray) -> np.ndarray:
        """Whether articles may be shown at hours of the same shape."""
        return np.asarray((self.published[articles] <= hour) & (hour < self.expires[articles]))

    def goes_on(self, clicks: int | np.ndarray, draws: float | np.ndarray) -> np.ndarray:
        """Whether another page follows one with so many clicks, by draws from [0, 1)."""
        return np.asarray(draws <= 0.45 + 0.25 * np.minimum(clicks, 2))

    def chances(
        self, visitor: int | np.ndarray, articles: np.ndarray, hour: float | np.ndarray
    ) -> np.ndarray:
        """Probabilities of a click on each article of a page, from the top; or of many pages, each
        a row, with visitors and hours in columns."""
        odds = 3.2 * self.taste[visitor, self.section[articles]] + 0.7 * self.quality[articles]
        place = np.arange(articles.shape[-1])
        odds -= 2.7 + 0.02 * (hour - self.published[articles]) + 0.12 * place
        return np.asarray(1 / (1 + np.exp(-odds)))

    def draw_log(self, sessions: int, seed: int) -> pd.DataFrame:
        """Sessions of one to six pages, which clicks make longer."""
        rng, rows = np.random.default_rng([seed, 1]), []
        for hour in np.sort(rng.uniform(0, 24 * DAYS, sessions)):
            visitor, explores = int(rng.integers(VISITORS)), rng.random() < 0.1
            seen = set[int]()
            for page in range(LONGEST):
                fresh = np.setdiff1d(self.alive(hour), list(seen))
                score = rng.gumbel(size=len(fresh))
                if not explores:
                    score += self.quality[fresh] - 0.04 * (hour - self.published[fresh])
                articles = fresh[np.argsort(-score)[:PAGE]]
                clicks = rng.random(len(articles)) < self.chances(visitor, articles, hour)
                time = START + pd.Timedelta(hours=hour)
                for place, (article, click) in enumerate(zip(articles, clicks, strict=True)):
                    chance = 1 / (len(fresh) - place) if explores else None
                    name = f"{visitor}-{time:%d%H%M%S}-{page}"
                    rows.append((name, visitor, article, time, place + 1, click, chance))
                seen.update(articles.tolist())
                if not self.goes_on(clicks.sum(), rng.random()):
                    break
                hour += rng.uniform(0.01, 0.07)
        names = ["page", "visitor", "article", "shown_at", "position", "clicked", "propensity"]
        return pd.DataFrame(rows, columns=names)


def make_log(folder: Path, sessions: int = 6_000, seed: int = 0) -> News:
    """Write the log to a folder; returns how it came about."""
    news = News(seed)
    log = news.draw_log(sessions, seed)
    folder.mkdir(parents=True, exist_ok=True)
    log.assign(clicked=log.clicked.astype(int)).to_parquet(folder / "impressions.parquet")
    times = {"published_at": news.published, "expires_at": news.expires}
    columns = {n: (START + pd.to_timedelta(v, "h")).round("s") for n, v in times.items()}
    sections = [SECTIONS[number] for number in news.section]
    articles = pd.DataFrame({"article": range(ARTICLES), "section": sections, **columns})
    articles.to_csv(folder / "articles.csv", index=False)
    (folder / "news.toml").write_text(MAPPING)
    return news


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write a simulated publisher's log.")
    parser.add_argument("folder", type=Path, nargs="?", default=Path("news"))
    make_log(target := parser.parse_args().folder)
    for file in sorted(target.iterdir()):
        print(f"{file}: {file.stat().st_size / 1e6:.1f} MB")
