// Particles of one garment that keep apart, so that it does not fold into itself.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <vector>

#include "cloth/constraints.hpp"
#include "cloth/lanes.hpp"
#include "cloth/surface.hpp"

namespace smplxpp {

class Pairs {
public:
    Pairs(const Model& model, float margin) : m_(model), margin_(margin) {
        if (!(margin_ > 0)) return;
        first_.assign(size_t(m_.particles) + 1, 0), other_.resize(2 * size_t(m_.edges));
        for (int64_t k = 0; k < 2 * m_.edges; ++k) ++first_[size_t(m_.edge[k])];
        std::partial_sum(first_.begin(), first_.end(), first_.begin());
        for (int64_t k = 0; k < 2 * m_.edges; ++k) other_[size_t(--first_[size_t(m_.edge[k])])] = m_.edge[k ^ 1];
    }

    // Looks for particles that no edge joins and that are nearer than the margin or soon may be.
    void find(const std::vector<Vec4>& x) {
        const size_t n = size_t(m_.particles);
        const float reach = kReach * margin_;
        place_.resize(n), pairs_.clear();
        std::transform(x.begin(), x.begin() + int64_t(n), place_.begin(), narrowed);
        grid_.fill(place_.data(), m_.particles, reach);
        // In the order of the grid, a coordinate a row, and read by fours; what is read behind the last one is infinitely far.
        row_ = n + kLanes, sorted_.assign(3 * row_, INFINITY);
        for (size_t k = 0; k < n; ++k) {
            const Vec3 p = place_[size_t(grid_.order()[k])];
            sorted_[k] = p.x, sorted_[row_ + k] = p.y, sorted_[2 * row_ + k] = p.z;
        }
        for (int32_t q = 0; q < int32_t(n); ++q) {
            const int32_t i = grid_.order()[size_t(q)];
            const Soa place = broadcast(place_[size_t(i)]);
            const float most = reach * reach;
            grid_.in(grid_.block(place_[size_t(i)]), [&](int32_t begin, int32_t end) {
                for (int32_t k = std::max(begin, q + 1); k < end; k += kLanes) {
                    const Soa d = place - four(k);
                    const Mask4 near = dot(d, d) < most;
                    if (!any(near)) continue;
                    for (int lane = 0; lane < std::min(kLanes, end - k); ++lane)
                        if (near[lane]) keep(i, grid_.order()[size_t(k + lane)]);
                }
            });
        }
    }

    // Moves what is too near apart, by inverse masses.
    void part(std::vector<Vec4>& x) const {
        for (const auto& [i, j, margin] : pairs_) {
            const float masses = m_.inverse_mass[i] + m_.inverse_mass[j];
            const Vec4 d = x[size_t(i)] - x[size_t(j)];
            const float squared = dot(d, d);
            if (squared >= margin * margin || masses == 0) continue;
            const float l = std::sqrt(squared);
            if (!(l >= 1e-7f)) continue;
            const Vec4 step = d * ((margin - l) / (masses * l));
            x[size_t(i)] += step * m_.inverse_mass[i];
            x[size_t(j)] -= step * m_.inverse_mass[j];
        }
    }

private:
    static constexpr float kReach = 1.5f;  // times the margin, within which pairs are found until the next search
    struct Pair {
        int32_t i, j;
        float margin;
    };
    // At rest a garment is as it was sewn: what is nearer there keeps that distance.
    void keep(int32_t i, int32_t j) {
        for (int32_t k = first_[size_t(i)]; k < first_[size_t(i) + 1]; ++k)
            if (other_[size_t(k)] == j) return;
        if (m_.inverse_mass[i] + m_.inverse_mass[j] > 0)
            pairs_.push_back({i, j, std::min(margin_, std::min(m_.apart[i], m_.apart[j]))});
    }
    Soa four(int32_t from) const {
        Soa out;
        const float* at = sorted_.data() + from;
        std::memcpy(&out.x, at, sizeof out.x), std::memcpy(&out.y, at + row_, sizeof out.y);
        std::memcpy(&out.z, at + 2 * row_, sizeof out.z);
        return out;
    }

    const Model& m_;
    float margin_;
    std::vector<int32_t> first_, other_;  // of particles: where theirs begin among the other ends of edges
    std::vector<Vec3> place_;
    std::vector<float> sorted_;  // three rows of row_ floats
    size_t row_ = 0;
    std::vector<Pair> pairs_;
    Grid grid_;
};

}  // namespace smplxpp
