// --- part: levels

auto scale_of = [](int level) -> double { return level == 0 ? 0.0 : Bits::power_of_two(level - Bits::BIAS); };
auto cell_at = [](double x, double scale) -> int {
    const double cell = floor(x * scale);
    return cell < -0x1p30 ? -(1 << 30) : cell > 0x1p30 ? 1 << 30 : (int)cell;
};
auto bucket_of = [](int level, const int* cell, int buckets) -> int {
    unsigned int word = (unsigned int)level * 0x9e3779b1u;
    for (int k = 0; k < DIM; ++k) {
        word = (word ^ (unsigned int)cell[k]) * 0x85ebca6bu;
        word ^= word >> 15;
    }
    word *= 0xc2b2ae35u;
    return (int)((word ^ (word >> 16)) & (unsigned int)(buckets - 1));
};
auto bucket_at = [&](const real* p, int level, int buckets) -> int {
    const double scale = scale_of(level);
    int cell[DIM];
    for (int k = 0; k < DIM; ++k)
        cell[k] = cell_at(double(p[k]), scale);
    return bucket_of(level, cell, buckets);
};
