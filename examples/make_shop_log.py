"""Simulate the log of a small web shop, for the documentation and the notebooks.

    python examples/make_shop_log.py shop

writes to the folder `shop`:

- `impressions.parquet` and `impressions_late.parquet`: one row per product shown, of five weeks and
  of the two weeks after them. `visitor` and `sku` are text, `shown_at` is a timestamp with a time
  zone, `view`, `cart` and `buy` are 0 or 1, `revenue` is missing unless the product was bought, and
  `propensity` is the probability with which the shop's recommender chose the product;
- `products.csv`: `sku`, `category`, `brand` and `price`, with a few missing prices;
- `shop.toml`: the mapping for `ucfrec prepare --mapping`.

The log has the usual faults: 1% of the rows are repeated, some identifiers are missing, and one
visitor is a bot.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

CATEGORIES = ("shoes", "shirts", "bags", "lamps", "games")
PRODUCTS, VISITORS, TASTES = 40, 3_000, 3
START = pd.Timestamp("2024-09-02", tz="Europe/Berlin")
WEEK_S = 7 * 86_400
"""Seconds of a week."""
MAPPING = """\
reward = "view + 2 * cart + 5 * buy"

[columns]
user_id = "visitor"
item_id = "sku"
timestamp = "shown_at"

[[item_features]]
files = ["products.csv"]
key = "sku"
columns = ["category", "brand", "ln(price)"]
"""


@dataclass(frozen=True)
class Shop:
    """Visitors and products, and what visitors do; V visitors, P products."""

    affinity: np.ndarray
    """Log-odds (V, P) of a view, before satiation."""
    category: np.ndarray
    """Category (P,) of each product, an index into `CATEGORIES`."""
    price: np.ndarray
    """Price (P,) of each product, in euros."""
    guess: np.ndarray
    """What the shop's own recommender believes about `affinity`, (V, P)."""

    @classmethod
    def draw(cls, seed: int) -> "Shop":
        """A shop whose visitors each like some categories."""
        rng = np.random.default_rng(seed)
        category = np.arange(PRODUCTS) % len(CATEGORIES)
        taste = rng.normal(size=(VISITORS, TASTES))
        style = rng.normal(size=(len(CATEGORIES), TASTES)) / np.sqrt(TASTES)
        quality = rng.normal(0, 1.0, PRODUCTS)
        affinity = -1.2 + 1.5 * (taste @ style.T)[:, category] + quality
        guess = 0.3 * quality + rng.normal(0, 0.7, (VISITORS, PRODUCTS))
        return cls(affinity, category, np.round(np.exp(rng.normal(3, 0.6, PRODUCTS)), 2), guess)

    def propensities(self, visitor: int) -> np.ndarray:
        """Probabilities (P,) with which the shop's recommender shows each product."""
        weight = np.exp(0.6 * self.guess[visitor])
        return np.asarray(0.7 * weight / weight.sum() + 0.3 / PRODUCTS)

    def view_probability(self, visitor: int, product: int, shown: list[int]) -> float:
        """Probability of a view; a category shown in the last two steps is less interesting."""
        repeats = sum(self.category[other] == self.category[product] for other in shown[-2:])
        return float(1 / (1 + np.exp(1.2 * repeats - self.affinity[visitor, product])))


Row = tuple[int, int, int, int, float]


def session(shop: Shop, visitor: int, rng: np.random.Generator, bot: bool = False) -> list[Row]:
    """Rows of one visit: product, view, cart, buy, propensity. Visitors who view stay longer."""
    rows: list[Row] = []
    shown: list[int] = []
    chances = shop.propensities(visitor)
    while True:
        product = int(rng.choice(PRODUCTS, p=chances))
        view = bot or rng.random() < shop.view_probability(visitor, product, shown)
        cart = not bot and view and rng.random() < 0.3
        buy = cart and rng.random() < 0.4
        rows.append((product, int(view), int(cart), int(buy), chances[product]))
        shown.append(product)
        if len(rows) >= 2_000 or (not bot and rng.random() < (0.2 if view else 0.5)):
            return rows


def make_log(folder: Path, sessions: int = 12_000, seed: int = 0) -> Shop:
    """Write the files to `folder` (created) and return the shop, whose visitors are known."""
    shop, rng = Shop.draw(seed), np.random.default_rng(seed + 1)
    folder.mkdir(parents=True, exist_ok=True)
    names = ["visitor", "sku", "shown_at", "view", "cart", "buy", "revenue", "propensity"]
    rows = []
    visits = [(int(rng.integers(VISITORS)), False) for _ in range(sessions)]
    for visitor, bot in [*visits, (0, True)]:
        clock = rng.random() * (2 if bot else 7) * WEEK_S
        name = "bot-1" if bot else f"v{visitor:05}"
        for product, view, cart, buy, chance in session(shop, visitor, rng, bot):
            at = START + pd.Timedelta(milliseconds=round(clock * 1_000))
            revenue = shop.price[product] if buy else np.nan
            rows.append((name, f"SKU-{product:03}", at, view, cart, buy, revenue, chance))
            clock += 1 if bot else rng.exponential(30)
    log = pd.DataFrame(rows, columns=names)
    log = pd.concat([log, log.sample(frac=0.01, random_state=seed)]).sort_values("shown_at")
    log = log.reset_index(drop=True)
    log.loc[rng.choice(len(log), 20, replace=False), "visitor"] = None
    late = log["shown_at"] >= START + pd.Timedelta(weeks=5)
    log[~late].to_parquet(folder / "impressions.parquet", index=False)
    log[late].to_parquet(folder / "impressions_late.parquet", index=False)
    products = pd.DataFrame(
        {
            "sku": [f"SKU-{product:03}" for product in range(PRODUCTS)],
            "category": [CATEGORIES[index] for index in shop.category],
            "brand": [f"brand {product % 7}" for product in range(PRODUCTS)],
            "price": shop.price,
        }
    )
    products.loc[[3, 17, 31], "price"] = np.nan
    products.to_csv(folder / "products.csv", index=False)
    (folder / "shop.toml").write_text(MAPPING, encoding="utf-8")
    return shop


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write a simulated shop's log.")
    parser.add_argument("folder", type=Path, nargs="?", default=Path("shop"))
    make_log(target := parser.parse_args().folder)
    for file in sorted(target.iterdir()):
        print(f"{file}: {file.stat().st_size / 1e6:.1f} MB")
