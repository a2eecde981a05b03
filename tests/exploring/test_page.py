"""The explorer in a real browser, and without one: lists, errors, sliders, two runs, no scripts."""

import asyncio
import json
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from tests.recommending.test_recommend import SMALL, random_log
from tests.support.browser import CHROMIUM, Browser
from ucfrec import DecisionRule, Recommender

httpx = pytest.importorskip("httpx")
pytest.importorskip("fastapi")
uvicorn = pytest.importorskip("uvicorn")
# After the check that they are installed.
from ucfrec.errors import InputError  # noqa: E402
from ucfrec.exploring.page import Explorer, application  # noqa: E402

HOSTILE = "<script>alert(1)</script>"
TITLES = [HOSTILE, *(f"Film {n}" for n in range(1, 30))]
IMAGES = ["javascript:alert(1)", *("https://example.org/x.png",) * 29]
FEATURES = pa.table({"item_id": list(range(30)), "title": TITLES, "image_url": IMAGES})


@pytest.fixture(scope="module")
def explorer(tmp_path_factory: pytest.TempPathFactory) -> Explorer:
    folder = tmp_path_factory.mktemp("explore")
    first = Recommender("dt", settings=["train.steps=60", *SMALL[1:]])
    first.fit(random_log(), folder / "first")
    second = Recommender("popular").fit(random_log(), folder / "second")
    later = random_log().assign(propensity=1 / 30)
    results = []
    for target in (1.0, 6.0):
        report = first.ope(later, rule=DecisionRule(target, temperature=1.0))
        results.append(folder / f"{target}.json")
        report.save(results[-1])
    found = Explorer([first.trained, second.trained], FEATURES, results)
    found.kept = first, second  # type: ignore[attr-defined]  # their stores
    return found


@pytest.fixture(scope="module")
def address(explorer: Explorer) -> Iterator[str]:
    config = uvicorn.Config(application(explorer, ["127.0.0.1"]), port=0, log_level="error")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.05)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join()


def got(explorer: Explorer, path: str, host: str = "127.0.0.1", **given: str) -> Any:
    async def ask() -> Any:
        transport = httpx.ASGITransport(app=application(explorer, ["127.0.0.1"]))
        async with httpx.AsyncClient(transport=transport, base_url=f"http://{host}") as client:
            return await client.get(path, params=given)

    return asyncio.run(ask())


def test_the_page_works_without_scripts(explorer: Explorer) -> None:
    answer = got(explorer, "/", user="7", k="3", keep_seen="on")
    assert answer.status_code == 200
    assert answer.text.count('class="card"') == 6
    assert "Film" in answer.text
    rule = {"custom": "on", "reward_weight": "0", "temperature": "0"}
    assert "only here" in got(explorer, "/", user="7", k="3", keep_seen="on", **rule).text
    assert "script-src 'self'" in answer.headers["content-security-policy"]
    assert "Model card" in got(explorer, "/report/0").text
    assert got(explorer, "/report/7").status_code == 404


def test_it_opens_with_an_example_user_and_the_history_first(explorer: Explorer) -> None:
    page = got(explorer, "/").text
    example = str(explorer.examples[0])
    assert f'name="user" list="users" value="{example}"' in page
    assert page.index(f"What was shown to user {example} before") < page.index("recommends</h2>")
    # The number in the field is that of the cards.
    assert 'name="k" min="1" max="100" value="10"' in page
    assert page.count('class="card"') == 20
    assert "Choose a user" in got(explorer, "/", user="").text
    assert "<noscript><button" in page


def test_the_moment_and_the_candidates_are_those_of_the_form(explorer: Explorer) -> None:
    page = got(explorer, "/", user="7", keep_seen="on", candidates="3\r\n 5 \r\n\r\n").text
    assert set(re.findall('data-item="([^"]*)"', page)) == {"3", "5"}
    assert page.count('class="card"') == 4
    early = got(explorer, "/", user="7", time="1990-01-01T00:00").text
    assert "0 rows; the latest 0, from the last. A new session begins" in early
    assert early.count('class="card"') == 20


def test_a_rule_that_draws_is_explained(explorer: Explorer) -> None:
    custom = {"user": "7", "custom": "on", "reward_weight": "0"}
    words = "This rule draws", "probability ", "by chance</span>"
    for temperature, draws in (("2", True), ("0", False)):
        text = got(explorer, "/results", temperature=temperature, **custom).text
        assert [word in text for word in words] == [draws] * 3


def test_what_results_say_is_on_the_page(explorer: Explorer) -> None:
    page = got(explorer, "/").text
    assert "the log cannot say" in page
    assert page.count("<figure>") == 1
    assert "Mean return of a session" in page
    assert "<figure>" not in Explorer(explorer.runs).page({})


def test_texts_of_others_are_no_markup(explorer: Explorer) -> None:
    page = got(explorer, "/", history=f"0, 1\n{HOSTILE}").text
    assert HOSTILE not in page
    assert 'role="alert"' in page
    listed = got(explorer, "/results", history="3, 1", k="30").text
    assert HOSTILE not in listed
    assert "javascript:" not in listed
    assert got(explorer, "/", host="evil.example").status_code == 400


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"user": "nobody"}, "has no user &#39;nobody&#39;; choose one of the list, or paste"),
        ({"user": "7", "k": "0"}, "k is &#39;0&#39;; give a number from 1 to 100"),
        ({"user": "7", "custom": "on", "temperature": "x"}, "temperature is"),
        ({"user": "7", "custom": "on", "temperature": "-1"}, "give a number from 0 to 2"),
        (
            {"user": "7", "time": "noon"},
            "time is &#39;noon&#39;; give one such as 2024-05-01T10:00",
        ),
        ({"user": "7", "candidates": "99"}, "1 of 1 named items are not known"),
        ({"history": "99, 1"}, "item_id that the policy does not know (1 item"),
        ({"history": "3, much"}, "line 1 of the history"),
    ],
)
def test_a_page_says_what_is_wrong(explorer: Explorer, given: dict[str, str], message: str) -> None:
    assert message in got(explorer, "/", **given).text


def test_one_run_without_its_store_takes_a_pasted_history(explorer: Explorer) -> None:
    trained = explorer.runs[0]
    gone = trained.record.model_copy(update={"store": "gone", "store_from_run": None})
    alone = Explorer([replace(trained, record=gone)])
    said = "its store gone is gone or has changed; paste a history instead"
    assert said in alone.results({"user": "7"})
    listed = alone.results({"history": "3, 1"})
    assert 'class="card"' in listed
    assert "only here" not in listed
    with pytest.raises(InputError, match="0 runs are named"):
        Explorer([])
    with pytest.raises(InputError, match="does not exist"):
        Explorer(explorer.runs, None, [Path("nowhere.json")])


def fill(browser: Browser, field: str, value: str) -> None:
    browser.run(
        f"(() => {{ const f = document.getElementById('{field}'); f.value = {json.dumps(value)};"
        "f.dispatchEvent(new Event('input', {bubbles: true})); })()"
    )


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_a_visitor_moves_a_slider_and_pastes_a_history(address: str, tmp_path: Path) -> None:
    first = "[...document.querySelectorAll('section:first-of-type .card')].map(c => c.dataset.item)"
    with Browser(tmp_path / "profile") as browser:
        browser.view(1200, 900)
        browser.open(f"{address}/?user=7&k=6&keep_seen=on")
        before = browser.run(first)
        assert len(before) == 6
        fill(browser, "reward_weight", "32")
        browser.until(f"JSON.stringify({first}) !== JSON.stringify({json.dumps(before)})")
        assert browser.run("form.elements.custom.checked")
        assert browser.run("document.querySelector('output[for=reward_weight]').value") == "32"
        assert "reward_weight=32" in browser.run("location.search")
        fill(browser, "history", "3, 1\n4, much")
        browser.until("document.querySelector('[role=alert]') !== null")
        assert "line 2" in browser.run("document.querySelector('[role=alert]').textContent")
        fill(browser, "history", "3, 1\n4, 0")
        browser.until("document.querySelectorAll('.card').length === 12")
        fill(browser, "candidates", "5\n6")
        browser.until("document.querySelectorAll('.card').length === 4")
        fill(browser, "k", "1")
        browser.until("document.querySelectorAll('.card').length === 2")
        fill(browser, "candidates", "")
        fill(browser, "time", "1990-01-01T00:00")
        browser.until("document.getElementById('results').textContent.includes('0 rows')")
        user = browser.run("document.querySelector('.example').dataset.user")
        browser.run("document.querySelector('.example').click()")
        browser.until(f"document.querySelector('h2').textContent.includes('user {user} before')")
        assert browser.run("form.elements.time.value + form.elements.history.value") == ""
        assert browser.run("document.querySelector('button')") is None
        fill(browser, "reward_weight", "0")
        fill(browser, "temperature", "2")
        fill(browser, "k", "6")
        browser.until("document.querySelectorAll('.note ~ .cards .card').length === 12")
        before = browser.run(first)
        fill(browser, "seed", "1")
        browser.until(f"JSON.stringify({first}) !== JSON.stringify({json.dumps(before)})")
        browser.view(375, 800, dark=True)
        assert browser.run("document.documentElement.scrollWidth") <= 375
        assert browser.run("getComputedStyle(document.body).backgroundColor") == "rgb(22, 24, 27)"


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_every_control_has_a_name_and_is_reached_by_keyboard(address: str, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile") as browser:
        browser.open(f"{address}/?user=7&k=3")
        nameless = browser.run(
            "[...document.querySelectorAll('input, textarea')]"
            ".filter(c => !c.labels.length).map(c => c.id)"
        )
        assert nameless == []
        reached = []
        for _ in range(30):
            for kind in ("keyDown", "keyUp"):
                browser.send("Input.dispatchKeyEvent", type=kind, key="Tab", code="Tab",
                             windowsVirtualKeyCode=9)  # fmt: skip
            reached.append(browser.run("document.activeElement.id"))
        controls = {"user", "history", "time", "k", "candidates", "keep_seen", "custom", "seed"}
        assert controls | {"reward_weight"} <= set(reached)
