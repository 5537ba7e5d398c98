"""The paper's own significance count, taken again from its published numbers."""

from scipy import stats as scipy_stats

from p2gs.bench.published import paper_table
from p2gs.bench.significance import counts, published_section, published_verdicts


def test_every_pair_that_both_methods_print_is_counted_once():
    pairs = [v[:3] for v in published_verdicts("printed")]
    # PARIS: 12 objects x 6 metrics less three positions of slides; multi-part: 7 x 6 less one
    assert len(pairs) == len(set(pairs)) == 12 * 6 - 3 + 7 * 6 - 1 == 110


def test_counts_add_up_and_rounding_makes_fewer_certain():
    printed, rounding = counts("printed"), counts("rounding")
    assert sum(printed.values()) == sum(rounding.values()) == 110
    assert dict(printed) == {"better": 73, "no difference": 36, "worse": 1}
    assert rounding["better"] <= printed["better"] and rounding["worse"] <= printed["worse"]
    assert [v for v in published_verdicts("printed") if v[3] == "worse"] == [("main_result", "Storage", "ang", "worse")]


def test_a_verdict_is_scipys():
    table = paper_table("main_result")
    verdicts = {v[1:3]: v[3] for v in published_verdicts("printed") if v[0] == "main_result"}
    for (row, object, metric), mine in table.numbers.items():
        theirs = table.numbers.get(("ArtGS", object, metric))
        if row != "Part2GS" or mine.value is None or not (mine.std and theirs.std):
            continue
        p = scipy_stats.ttest_ind_from_stats(
            mine.value, mine.std, 3, theirs.value, theirs.std, 3, equal_var=False
        ).pvalue
        expected = "no difference" if p >= 0.05 else "better" if mine.value < theirs.value else "worse"
        assert verdicts[object, metric] == expected, (object, metric)


def test_the_section_has_the_papers_count_beside_ours():
    text = published_section()
    assert "| as the paper states it | 111 | 83 | 25 | 3 |" in text and "| 110 | 73 | 36 | 1 |" in text
