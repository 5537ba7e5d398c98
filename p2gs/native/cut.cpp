#include "cut.h"

#include <algorithm>
#include <deque>
#include <limits>
#include <vector>

namespace p2gs {
namespace {

constexpr int8_t kNone = -1, kTerminal = -2;  // of a parent, else the direction in which it is
constexpr int32_t kFar = std::numeric_limits<int32_t>::max();
enum : uint8_t { kSink, kSource, kFree };

// Two trees of residual edges, one grown from the source, one from the sink. Where they touch, flow is pushed along the path between the
// terminals; nodes behind edges that this fills are orphans, which find another parent in their tree or leave it.
class Trees {
   public:
    Trees(const CutGraph& graph, uint8_t* side)
        : g(graph), tree(side), parent(g.nodes, kNone), queued(g.nodes, 0), checked(g.nodes, 0), far(g.nodes, 0) {
        for (int32_t i = 0; i < g.nodes; ++i) {
            tree[i] = g.pull[i] > 0 ? kSource : g.pull[i] < 0 ? kSink : kFree;
            if (tree[i] == kFree) continue;
            parent[i] = kTerminal;
            far[i] = 1;
            activate(i);
        }
    }

    int64_t flow() {
        while (!active.empty()) {
            const int32_t i = active.front();
            if (tree[i] == kFree || !grow(i)) {
                active.pop_front();
                queued[i] = 0;
            }
        }
        return total;
    }

   private:
    const CutGraph g;
    uint8_t* tree;
    std::vector<int8_t> parent;
    std::vector<uint8_t> queued;
    std::vector<int32_t> checked, far;  // when a node was last known to hang from a terminal, and over how many edges
    std::deque<int32_t> active, orphans;
    int32_t now = 0;
    int64_t total = 0;

    int32_t at(int32_t i, int d) const { return g.neighbours[int64_t(i) * g.k + d]; }
    int32_t& room(int32_t i, int d) { return g.capacity[int64_t(i) * g.k + d]; }

    // Room for flow between i and its neighbour j in direction d, in the direction in which i's tree lets it pass from j to i.
    int32_t& inward(int32_t i, int d, uint8_t side) { return side == kSource ? room(at(i, d), d ^ 1) : room(i, d); }

    void activate(int32_t i) {
        if (queued[i]) return;
        queued[i] = 1;
        active.push_back(i);
    }

    // Whether a path was found, and flow pushed along it.
    bool grow(int32_t i) {
        const uint8_t side = tree[i];
        for (int d = 0; d < g.k; ++d) {
            const int32_t j = at(i, d);
            if (j < 0 || (side == kSource ? room(i, d) : room(j, d ^ 1)) == 0) continue;
            if (tree[j] == kFree) {
                tree[j] = side;
                adopt_by(j, d ^ 1, i);
                activate(j);
            } else if (tree[j] != side) {
                side == kSource ? push(i, d) : push(j, d ^ 1);
                return true;
            } else if (checked[j] <= checked[i] && far[j] > far[i] + 1) {
                adopt_by(j, d ^ 1, i);  // a shorter way
            }
        }
        return false;
    }

    void adopt_by(int32_t j, int d, int32_t i) {
        parent[j] = int8_t(d);
        checked[j] = checked[i];
        far[j] = far[i] + 1;
    }

    // Push what fits along source .. i -> its neighbour in direction d .. sink.
    void push(int32_t i, int d) {
        const int32_t j = at(i, d);
        int32_t most = std::min({room(i, d), narrowest(i, kSource), narrowest(j, kSink)});
        ++now;
        room(i, d) -= most;
        room(j, d ^ 1) += most;
        take(i, kSource, most);
        take(j, kSink, most);
        total += most;
        while (!orphans.empty()) {
            const int32_t o = orphans.front();
            orphans.pop_front();
            find_parent(o);
        }
    }

    int32_t narrowest(int32_t i, uint8_t side) {
        int32_t most = kFar;
        for (; parent[i] != kTerminal; i = at(i, parent[i])) most = std::min(most, inward(i, parent[i], side));
        return std::min(most, side == kSource ? g.pull[i] : -g.pull[i]);
    }

    void take(int32_t i, uint8_t side, int32_t amount) {
        while (parent[i] != kTerminal) {
            const int d = parent[i];
            const int32_t j = at(i, d);
            int32_t& along = inward(i, d, side);
            along -= amount;
            (side == kSource ? room(i, d) : room(j, d ^ 1)) += amount;
            if (along == 0) orphan(i);
            i = j;
        }
        g.pull[i] += side == kSource ? -amount : amount;
        if (g.pull[i] == 0) orphan(i);
    }

    void orphan(int32_t i) {
        parent[i] = kNone;
        orphans.push_back(i);
    }

    // Over how many edges a node hangs from its terminal; kFar: from an orphan.
    int32_t depth(int32_t i) {
        int32_t steps = 0, j = i;
        for (; checked[j] != now; j = at(j, parent[j]), ++steps) {
            if (parent[j] == kNone) return kFar;
            if (parent[j] == kTerminal) {
                checked[j] = now;
                far[j] = 1;
                break;
            }
        }
        const int32_t whole = steps + far[j];
        for (int32_t left = whole, m = i; m != j; m = at(m, parent[m]), --left) {
            checked[m] = now;
            far[m] = left;
        }
        return whole;
    }

    void find_parent(int32_t i) {
        const uint8_t side = tree[i];
        int best = kNone;
        int32_t least = kFar;
        for (int d = 0; d < g.k; ++d) {
            const int32_t j = at(i, d);
            if (j < 0 || tree[j] != side || parent[j] == kNone || inward(i, d, side) == 0) continue;
            const int32_t steps = depth(j);
            if (steps < least) least = steps, best = d;
        }
        if (best != kNone) {
            adopt_by(i, best, at(i, best));
            return;
        }
        tree[i] = kFree;
        for (int d = 0; d < g.k; ++d) {
            const int32_t j = at(i, d);
            if (j < 0 || tree[j] != side) continue;
            if (inward(i, d, side) > 0) activate(j);
            if (parent[j] >= 0 && at(j, parent[j]) == i) orphan(j);
        }
    }
};

}  // namespace

int64_t least_cut(const CutGraph& graph, uint8_t* side) { return Trees(graph, side).flow(); }

}  // namespace p2gs
