// What cloth may touch: points by the cells of a grid, and the nearest place of a moving surface.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "cloth/lanes.hpp"
#include "cloth/vec3.hpp"

namespace smplxpp {

// Points by the cell of a grid that they lie in.
class Grid {
public:
    // Cells are a little wider than twice the reach: all within it of a place lie in the 8 cells that are nearest to that.
    void fill(const Vec3* points, int64_t count, float reach) {
        over_ = 1.0f / (2.01f * reach);
        first_.assign(kCells + 1, 0);
        at_.resize(size_t(count));
        order_.resize(size_t(count));
        for (int32_t i = 0; i < count; ++i) {
            at_[size_t(i)] = key(cell(points[i].x), cell(points[i].y), cell(points[i].z));
            ++first_[at_[size_t(i)]];
        }
        for (uint32_t k = 1; k <= kCells; ++k) first_[k] += first_[k - 1];
        for (int32_t i = 0; i < count; ++i) order_[size_t(--first_[at_[size_t(i)]])] = i;  // the last one first
    }
    // The 8 cells that are nearest to a place, by the first of them.
    struct Block {
        int32_t x, y, z;
        friend bool operator==(Block a, Block b) { return a.x == b.x && a.y == b.y && a.z == b.z; }
        uint32_t hash() const { return uint32_t(x) * 73856093u ^ uint32_t(y) * 19349663u ^ uint32_t(z) * 83492791u; }
    };
    Block block(Vec3 p) const { return {first(p.x), first(p.y), first(p.z)}; }

    // The points, cell by cell.
    const std::vector<int32_t>& order() const { return order_; }
    // Calls visit with ranges of the order: the points within the reach of a place, and others about it; some of those twice.
    template <class Visit>
    void in(Block b, Visit&& visit) const {
        for (int32_t i = b.x; i <= b.x + 1; ++i)
            for (int32_t j = b.y; j <= b.y + 1; ++j) {
                const uint32_t at = key(i, j, b.z);
                const auto some = [&](uint32_t from, uint32_t to) {
                    if (first_[from] < first_[to]) visit(first_[from], first_[to]);
                };
                if (at + 1 < kCells)
                    some(at, at + 2);
                else
                    some(at, kCells), some(0, 1);
            }
    }

private:
    static constexpr uint32_t kCells = 1u << 12;
    // Cells that lie one behind the other along z have keys that follow each other: their points are one range.
    static uint32_t key(int32_t i, int32_t j, int32_t k) { return (Block{i, j, 0}.hash() + uint32_t(k)) & (kCells - 1); }
    static int32_t whole(float x) {  // far and broken points share a cell: a cast of them has no value
        const float down = std::floor(x);
        return down > -1e9f && down < 1e9f ? int32_t(down) : 0;
    }
    int32_t cell(float x) const { return whole(x * over_); }
    int32_t first(float x) const { return whole(x * over_ - 0.5f); }  // of the two cells nearest to a place
    float over_ = 1.0f;
    std::vector<uint32_t> at_;              // of points: their cells
    std::vector<int32_t> first_, order_;  // of cells: where their points begin; the points, cell by cell
};

struct Contact {
    int32_t face;  // of the collider, -1: none
    float weight[3];
};

template <class Vec>
void add_normals(const Vec* x, const int32_t* face, int64_t count, Vec* out) {
    for (int64_t k = 0; k < count; ++k) {
        const int32_t* q = face + 3 * k;
        const Vec n = cross(x[q[1]] - x[q[0]], x[q[2]] - x[q[0]]);
        for (int j = 0; j < 3; ++j) out[q[j]] = out[q[j]] + n;
    }
}

template <class Vec>
void normals(const Vec* x, const int32_t* face, int64_t faces, std::vector<Vec>& out) {
    std::fill(out.begin(), out.end(), Vec{0, 0, 0});
    add_normals(x, face, faces, out.data());
    for (Vec& n : out) n = n * (1.0f / std::max(length(n), 1e-12f));
}

// A moving surface that cloth may touch: where a point's nearest vertex is, and the nearest place on its faces
// and on those about.
class Surface {
public:
    Surface(int64_t vertices, const int32_t* face, int64_t faces)
        : face_(face), faces_(faces), normal_(size_t(vertices)), first_(size_t(vertices) + 1, 0), at_(3 * size_t(faces)) {
        for (size_t i = 0; i < at_.size(); ++i) ++first_[size_t(face[i]) + 1];
        for (size_t i = 0; i + 1 < first_.size(); ++i) first_[i + 1] += first_[i];
        std::vector<int32_t> next(first_.begin(), first_.end() - 1);
        for (size_t i = 0; i < at_.size(); ++i) at_[size_t(next[size_t(face[i])]++)] = int32_t(i / 3);
    }
    // Take the vertices as they are now; nearest() and find_from() look among these.
    void look(const Vec3* vertex) {
        vertex_ = vertex;
        normals(vertex, face_, faces_, normal_);
        grid_.fill(vertex, int64_t(normal_.size()), kReach);
        known_.assign(kKnown, {{0, 0, 0}, 0, -1});
        ranges_.clear();
        // In the order of the grid, a coordinate a row: vertices of a cell are read by fours. What is read behind the last one is
        // infinitely far.
        const size_t count = normal_.size();
        row_ = count + kLanes;
        wide_.resize(count), sorted_.assign(kRows * row_, INFINITY);
        for (size_t i = 0; i < count; ++i) {
            const size_t j = size_t(grid_.order()[i]);
            const Vec3 p = vertex[j], n = normal_[j];
            const float values[kRows] = {p.x, p.y, p.z, n.x, n.y, n.z};
            for (size_t k = 0; k < kRows; ++k) sorted_[k * row_ + i] = values[k];
            wide_[i] = widened(vertex[i]);
        }
    }
    Vec3 normal(int32_t i) const { return normal_[size_t(i)]; }

    // The nearest vertex within reach that faces as the cloth does, -1: none.
    int32_t nearest(Vec3 p, Vec3 cloth_normal) {
        const Known about = about_block(grid_.block(p));
        int32_t near = -1;
        float best = kReach * kReach;
        const Soa place = broadcast(p), along = broadcast(cloth_normal);
        const Vec4 far = all_lanes(best);
        within_.clear();
        // A four may end with vertices of a cell that comes elsewhere, or has come: they count as they do there.
        for (int32_t r = about.begin; r < about.end; ++r)
            for (int32_t k = ranges_[size_t(r)].begin; k < ranges_[size_t(r)].end; k += kLanes) {
                const Soa d = place - four(0, k);
                const Vec4 squared = dot(d, d);
                if (!any(squared < far)) continue;
                within_.push_back(k);
                if (any(squared < best)) take(k, select(touched(four(3, k), along, d), squared, far), best, near);
            }
        return near;
    }
    // The same of the place that was last asked for, among vertices that face against a normal: the other side of a fold.
    int32_t nearest_against(Vec3 normal, Vec3 p, Vec3 cloth_normal) const {
        int32_t near = -1;
        float best = kReach * kReach;
        const Soa place = broadcast(p), along = broadcast(cloth_normal), against = broadcast(normal);
        const Vec4 far = all_lanes(best);
        for (const int32_t k : within_) {
            const Soa normal_of = four(3, k);
            const Mask4 faces = dot(normal_of, against) <= 0;
            if (!any(faces)) continue;
            const Soa d = place - four(0, k);
            take(k, select(touched(normal_of, along, d) & faces, dot(d, d), far), best, near);
        }
        return near;
    }
    // Whether a place is so far before its nearest vertex that no face about can be over it.
    bool clear(Vec3 p, int32_t near) const {
        const Vec3 d = p - vertex_[near];
        const float height = dot(d, normal_[size_t(near)]);
        return height > kClear && 2.0f * height * height > dot(d, d);
    }
    Contact find_from(int32_t near, Vec3 p, Vec3 cloth_normal) const {
        Contact found = {-1, {0, 0, 0}};
        if (near < 0) return found;
        float best = 1e9f;
        // Among large and small triangles the nearest face need not be one of the nearest vertex: where the place lies on
        // the far side of the vertex's faces, look on from there.
        for (int step = 0; step < kSteps && scan(p, near, best, found); ++step) {
            const int32_t* q = face_ + 3 * int64_t(found.face);
            int32_t next = near;
            float most = 0;
            for (int j = 0; j < 3; ++j) {
                if (q[j] == near && found.weight[j] > 0) return found;
                if (found.weight[j] > most) most = found.weight[j], next = q[j];
            }
            const Vec3 n = normal_[size_t(next)];
            if (!(dot(n, cloth_normal) > kCovers || dot(p - vertex_[next], n) > -kShallow)) break;
            near = next;
        }
        return found;
    }

private:
    static constexpr size_t kRows = 6;  // of a place and a normal
    struct Range {
        int32_t begin, end;
    };
    // A block of the grid, and which ranges of the vertices' order are its cells; end is -1 where none is known.
    struct Known {
        Grid::Block block;
        int32_t begin, end;
    };
    // The ranges of a block; places that lie together share them.
    const Known& about_block(Grid::Block block) {
        Known& known = known_[block.hash() & (kKnown - 1)];
        if (known.end >= 0 && known.block == block) return known;
        const int32_t begin = int32_t(ranges_.size());
        grid_.in(block, [&](int32_t first, int32_t last) { ranges_.push_back({first, last}); });
        return known = {block, begin, int32_t(ranges_.size())};
    }
    // Three rows of four vertices from one on in the grid's order: from 0 their places, from 3 their normals.
    Soa four(size_t row, int32_t from) const {
        Soa out;
        const float* at = sorted_.data() + row * row_ + size_t(from);
        std::memcpy(&out.x, at, sizeof out.x), std::memcpy(&out.y, at + row_, sizeof out.y);
        std::memcpy(&out.z, at + 2 * row_, sizeof out.z);
        return out;
    }

    // Skin that faces the cloth's outer side, an arm that lies on a flank, makes no contact with cloth that lies in it; cloth
    // before it stays there, whichever way its folds look.
    static Mask4 touched(Soa normal, Soa along, Soa d) {
        return (dot(normal, along) > kCovers) | (dot(normal, d) > -kShallow);
    }
    void take(int32_t from, Vec4 squared, float& best, int32_t& near) const {
        for (int lane = 0; lane < kLanes; ++lane)
            if (squared[lane] < best) best = squared[lane], near = grid_.order()[size_t(from + lane)];
    }

    // Looks for a place nearer than the best on the faces of a vertex; says whether there is one.
    bool scan(Vec3 p, int32_t vertex, float& best, Contact& found) const {
        bool nearer = false;
        const Soa place = broadcast(p);
        const int32_t begin = first_[size_t(vertex)], end = first_[size_t(vertex) + 1];
        for (int32_t k = begin; k < end; k += kLanes) {
            int32_t face[kLanes];  // the last one again where there are no more
            Soa corner[3];
            for (int lane = 0; lane < kLanes; ++lane) face[lane] = at_[size_t(std::min(k + lane, end - 1))];
            for (int j = 0; j < 3; ++j) {
                Vec4 at[kLanes];
                for (int lane = 0; lane < kLanes; ++lane) at[lane] = wide_[size_t(face_[3 * int64_t(face[lane]) + j])];
                corner[j] = columns(at[0], at[1], at[2], at[3]);
            }
            Vec4 weight[3];
            const Soa d = place - closest_on_triangles(place, corner[0], corner[1], corner[2], weight);
            const Vec4 squared = dot(d, d);
            for (int lane = 0; lane < kLanes; ++lane) {
                if (!(squared[lane] < best)) continue;  // nor a triangle without area
                best = squared[lane], nearer = true;
                found = {face[lane], {weight[0][lane], weight[1][lane], weight[2][lane]}};
            }
        }
        return nearer;
    }

    static constexpr uint32_t kKnown = 1u << 11;  // blocks that are remembered
    static constexpr int kSteps = 8;          // from one vertex's faces to the next one's
    static constexpr float kReach = 0.035f;   // metres within which a vertex is found
    static constexpr float kClear = 0.01f;    // metres before a vertex
    static constexpr float kCovers = -0.3f;   // least cosine between skin's and cloth's normals
    static constexpr float kShallow = 0.002f; // metres behind a vertex's plane up to which cloth counts as before it
    const int32_t* face_;
    int64_t faces_;
    const Vec3* vertex_ = nullptr;
    std::vector<Vec3> normal_;
    std::vector<int32_t> first_, at_;
    Grid grid_;
    std::vector<float> sorted_;  // kRows of the vertices in the grid's order, each of row_ floats
    size_t row_ = 0;
    std::vector<Vec4> wide_;     // the vertices
    std::vector<Known> known_;
    std::vector<Range> ranges_;
    std::vector<int32_t> within_;  // fours of whom one was within reach of the place that was last asked for
};

}  // namespace smplxpp
